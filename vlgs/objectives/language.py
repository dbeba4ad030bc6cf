"""Language: the second term of Eq. 8."""

from collections.abc import Callable
from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.losses import masked_cosine, masked_l1, masked_mse
from vlgs.objectives.objective import Objective, Setup, StepView
from vlgs.ops.squared_error import Pixels
from vlgs.values import require_choice

_ERRORS = {"mse": masked_mse, "l1": masked_l1, "cos": masked_cosine}


class Language(Objective):
    """How far the rendered codes of a view are from those of its masks (conf/README.md, D.8).

    Args:
        error: ``mse`` is the paper's, ``l1`` LangSplat's.
        pixels: Whether the mean is over the pixels that have a mask, or over all, as LangSplat's.

    Raises:
        ValueError: If there is no such error, or pixels.
    """

    needs = frozenset({"feature"})

    def __init__(
        self, error: Literal["mse", "l1", "cos"] = "mse", pixels: Pixels = "valid"
    ) -> None:
        require_choice("language", "error", error, tuple(_ERRORS))
        require_choice("language", "pixels", pixels, ("valid", "all"))
        self.error = error
        self.pixels: Pixels = pixels
        self.predict: Callable[[Tensor], Tensor] | None = None

    def bind(self, setup: Setup) -> None:
        """What is compared is said by the head of the model."""
        self.predict = setup.predict

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """One for each view that has language."""
        terms: dict[str, Tensor] = {}
        for place, render, target in zip("12", step.renders, step.targets, strict=True):
            if render.feature is not None and target.codes is not None:
                terms[f"language {place}"] = self.of(render.feature, target.codes, target.valid)
        return terms

    def of(
        self,
        feature: Float[Tensor, "h w c"],
        codes: Float[Tensor, "h wl t"],
        valid: Bool[Tensor, "h wl"] | None,
    ) -> Float[Tensor, ""]:
        """The error of one rendered map; with l mask levels a render has l d channels (`Target.codes`)."""
        shown = feature.view_as(codes) if self.predict is None else self.predict(feature)
        return _ERRORS[self.error](shown, codes, valid, self.pixels)
