"""Language: the second term of Eq. 8."""

from collections.abc import Callable
from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.heads import Head
from vlgs.heads.linear import Linear
from vlgs.losses import masked_cosine, masked_l1, masked_mse
from vlgs.objectives.mapped_error import mapped_l1
from vlgs.objectives.objective import Objective, Setup, StepView
from vlgs.objectives.targets import Target, TrainingViews, masked_codes
from vlgs.ops.squared_error import Pixels
from vlgs.values import require_choice, require_range

_ERRORS = {"mse": masked_mse, "l1": masked_l1, "cos": masked_cosine}


MOST = 1e6
"""Upper limit of weights, far above any useful one."""


class Language(Objective):
    """How far the rendered codes of a view are from those of its masks (conf/README.md, D.8).

    Args:
        error: ``mse`` is the paper's, ``l1`` LangSplat's.
        pixels: Whether the mean is over the pixels that have a mask, or over all, as LangSplat's.
        weight: Of all language in the loss, that of `BlendedView` included. Adam's steps of what language alone trains hardly depend on it: it is how much language
            has to say beside colour where a Gaussian goes and how opaque it is.
        support: Masks of which other views support less than this share are left out after a fifth of the iterations
            (`vlgs.training.mask_support`); 0: none is.

    Raises:
        ValueError: If there is no such error, or pixels, or the weight is not in (0, 1e6], or the support not in [0, 1].
    """

    needs = frozenset({"feature"})

    def __init__(
        self,
        error: Literal["mse", "l1", "cos"] = "mse",
        pixels: Pixels = "valid",
        weight: float = 1.0,
        support: float = 0.0,
    ) -> None:
        require_choice("language", "error", error, tuple(_ERRORS))
        require_choice("language", "pixels", pixels, ("valid", "all"))
        if not 0 < weight <= MOST:
            raise ValueError(f"language: weight must be above 0 and at most {MOST:g}, got {weight}")
        require_range("language", 0, 1, support=support)
        self.error = error
        self.weight = weight
        self.support = support
        self.pixels: Pixels = pixels
        self.predict: Callable[[Tensor], Tensor] | None = None
        self.views: TrainingViews | None = None
        self.head: Head | None = None

    def bind(self, setup: Setup) -> None:
        """What is compared is said by the head of the model."""
        self.predict = setup.model.predict
        self.head = setup.model.head
        # Targets of a head that learns are embeddings: a map of them is large, and most systems that have one leave pixels out.
        self.views = None if setup.model.head.learning_rate is None else setup.views

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """One for each view that has language."""
        terms: dict[str, Tensor] = {}
        error = self._of_masked if self.views is not None else self._of_map
        for place, _, feature, target in step.with_language():
            terms[f"language {place}"] = self.weight * error(feature, target)
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

    def _of_map(self, feature: Float[Tensor, "h w c"], target: Target) -> Float[Tensor, ""]:
        return self.of(feature, target.codes, target.valid)

    def _of_masked(self, feature: Float[Tensor, "h w c"], target: Target) -> Float[Tensor, ""]:
        """The same of the pixels that have a mask alone; no map is made of the targets."""
        assert self.predict is not None
        assert self.views is not None
        valid = target.valid
        count = int(valid.sum())
        if count == 0:
            return feature.sum() * 0
        codes, masks = masked_codes(feature, target)
        share = count / valid.numel() if self.pixels == "all" else 1.0
        if self.error == "l1" and isinstance(self.head, Linear):
            map_ = self.head.map
            error = mapped_l1(codes, map_.weight, map_.bias, self.views.codes, masks, share)
        else:
            error = _ERRORS[self.error](self.predict(codes[None]), self.views.codes_of(masks)[None])
        return error * share if self.pixels == "all" else error
