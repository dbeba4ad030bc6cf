"""Language by weights of a codebook: LangSplatV2's 1 - cos, without a map of embeddings (Li et al., NeurIPS 2025)."""

from collections.abc import Sequence
from typing import ClassVar

from jaxtyping import Float, Int
from torch import Tensor

from vlgs.demands import Demand
from vlgs.heads.codebook import Codebook
from vlgs.heads.rows import linear_rows
from vlgs.losses import RENDER_FLOOR, TARGET_FLOOR
from vlgs.objectives.objective import Objective, Setup, StepView
from vlgs.objectives.targets import masked_codes
from vlgs.ops.squared_error import Pixels
from vlgs.values import require_choice


class CodebookLanguage(Objective):
    """``1 - cos`` of the embedding of a mask and what the head predicts from the code, the entries' sum weighted by it.

    The value and its gradients are those of ``Language(error="cos")``. With E the entries as rows, c a code and t an embedding, ``E^T c``
    is never made: its product with t is ``c . (E t)``, where E t is the same for all pixels of a mask, and its squared length is
    ``c . (E E^T) c``. That takes numbers of 64 for each pixel in place of 512.

    Args:
        pixels: Whether the mean is over the pixels that have a mask, or over all, of which those without one count as zero.

    Raises:
        ValueError: If there are no such pixels.
    """

    demands: ClassVar[Sequence[Demand]] = (
        Demand("loss.codebook", "head", "has_entries", "as it learns the entries of a codebook"),
    )
    needs = frozenset({"feature"})

    def __init__(self, pixels: Pixels = "valid") -> None:
        require_choice("codebook language", "pixels", pixels, ("valid", "all"))
        self.pixels: Pixels = pixels

    def bind(self, setup: Setup) -> None:
        """The codebook is that of the head.

        Raises:
            ValueError: If the head has none.
        """
        head = setup.model.head
        if not isinstance(head, Codebook):
            raise ValueError(
                f"codebook language: head must be codebook, which has entries, got {type(head).__name__}"
            )
        self.head, self.views = head, setup.views

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """One term for each view that has language."""
        terms: dict[str, Tensor] = {}
        for place, _, feature, target in step.with_language():
            codes, masks = masked_codes(feature, target)
            if len(masks):
                count = target.masks.numel() if self.pixels == "all" else len(masks)
                terms[f"language {place}"] = self.total(codes, masks) / count
        return terms

    def total(self, codes: Float[Tensor, "p d"], masks: Int[Tensor, " p"]) -> Float[Tensor, ""]:
        """Sum of ``1 - cos`` over pixels with these codes and masks."""
        entries = self.head.entries
        rows, which = masks.unique(return_inverse=True)
        wanted = self.views.codes_of(rows)
        wanted = wanted / wanted.norm(dim=-1, keepdim=True).clamp_min(TARGET_FLOOR)
        # Of all masks of the view, one is taken for each pixel; to take the products' other side by mask would need a gradient that
        # threads add up in any order.
        products = linear_rows(codes, linear_rows(wanted, entries)).gather(1, which[:, None])[:, 0]
        squares = (codes * linear_rows(codes, linear_rows(entries, entries))).sum(dim=-1)
        return (1 - products / squares.clamp_min(RENDER_FLOOR**2).sqrt()).sum()
