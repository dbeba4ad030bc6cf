"""Language by classes of codes that may be doubted: the semantic terms of LEGaussians (Shi et al., CVPR 2024)."""

from collections.abc import Sequence
from typing import ClassVar

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import cross_entropy

from vlgs.demands import Demand
from vlgs.heads.quantised import QuantisedCodes
from vlgs.objectives.objective import Objective, Setup, StepView
from vlgs.objectives.targets import masked_codes
from vlgs.values import require_range

SUREST = 1e-6
"""Least certainty of a pixel, so that its logarithm is finite."""


class CodeClasses(Objective):
    """Cross-entropy of the class of a rendered code, which counts less where the Gaussians carry uncertainty, and a price for that.

    Over the pixels that have a mask, with u their rendered uncertainty: mean of ``(1 - u) CE`` and mean of ``-log(1 - u)``.

    Args:
        price: Weight of the second term.
        attribute: Name of the attribute that carries u (``gaussians.attributes``), of activation ``logistic`` and width 1.

    Raises:
        ValueError: If the weight is negative.
    """

    trains_classes: ClassVar[bool] = True
    """What its head asks of a loss."""
    demands: ClassVar[Sequence[Demand]] = (
        Demand("loss.classes", "head", "has_classes", "as it looks at the classes of codes"),
    )

    def __init__(self, price: float = 1.0, attribute: str = "uncertainty") -> None:
        require_range("code classes", 0, 1e6, price=price)
        self.price = price
        self.attribute = attribute
        self.needs = frozenset({"feature", attribute})

    def bind(self, setup: Setup) -> None:
        """The classes are those of the head.

        Raises:
            ValueError: If the head has none, or Gaussians carry no such attribute.
        """
        head = setup.model.head
        if not isinstance(head, QuantisedCodes):
            raise ValueError(
                f"code classes: head must be quantised, which has classes, got {type(head).__name__}"
            )
        require_attribute("code classes", setup, self.attribute)
        self.head, self.views = head, setup.views

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """Both terms of each view that has language."""
        terms: dict[str, Tensor] = {}
        for place, render, feature, target in step.with_language():
            codes, masks = masked_codes(feature, target)
            if len(masks):
                doubt = _of_valid(render.further[self.attribute], target.valid)
                error, price = self.terms(codes, self.views.codes_of(masks), doubt)
                terms |= {f"codes {place}": error, f"doubt {place}": price}
        return terms

    def terms(
        self, codes: Float[Tensor, "p d"], classes: Float[Tensor, "p k"], doubt: Float[Tensor, " p"]
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Both terms for pixels with these codes, classes and uncertainties; p is at least 1."""
        sure = (1 - doubt).clamp_min(SUREST)
        errors = cross_entropy(self.head.predict(codes), classes, reduction="none")
        return (errors * sure).mean(), -self.price * sure.log().mean()


def require_attribute(who: str, setup: Setup, name: str) -> None:
    """Refuse Gaussians without a further attribute that an objective reads.

    Raises:
        ValueError: Says how to add it.
    """
    if name not in setup.model.attributes:
        raise ValueError(
            f"{who}: gaussians.attributes must have {name}, got {', '.join(setup.model.attributes)}; "
            f"+gaussians.attributes.{name}='{{width: 1, activation: logistic}}' adds it"
        )


def _of_valid(image: Float[Tensor, "h w 1"], valid: Bool[Tensor, "h wl"]) -> Float[Tensor, " p"]:
    """Values of the pixels that have a mask; a pixel is there once for each mask level that it has one of."""
    levels = valid.shape[1] // image.shape[1]
    return image[..., 0].repeat_interleave(levels, dim=1)[valid]
