"""Mip-NeRF 360 as GOI evaluates it: masks per prompt, means over images of a prompt, then over prompts.

GAGS, LangSplatV2 and LEGO use other labels on the same photographs; that is `mipnerf360_gags`, and the two do not share a column.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from vlgs.metrics.masks import QueryScore, Unit, by_category, compare
from vlgs.metrics.mean import mean_of_known
from vlgs.metrics.ovs3d import select_level
from vlgs.metrics.protocol import Evidence, Figures, without_localisation
from vlgs.metrics.segment import LANGSPLAT, check_relevancy

VERSION = 1


@dataclass(frozen=True)
class Goi:
    """GOI's protocol.

    Its plain selection is a cosine above 0.86. That number belongs to APE's features: CLIP's cosines stay below 0.4, so that
    nothing is selected and every IoU is 0. ``select=relevancy`` takes the mask of LangSplat's segmentation instead, and says so
    in the tag. GOI's optimised hyperplane needs a referring-segmentation model and is not part of this.

    Args:
        select: ``cosine``, or ``relevancy``.
        threshold: Of the cosine; with several levels any level may pass it.

    Raises:
        ValueError: If `select` is neither or the threshold is no cosine.
    """

    select: Literal["cosine", "relevancy"] = "cosine"
    threshold: float = 0.86

    def __post_init__(self) -> None:
        if self.select not in ("cosine", "relevancy") or not -1 <= self.threshold < 1:
            raise ValueError(
                "mipnerf360_goi: select must be cosine or relevancy and threshold in [-1, 1), got "
                f"{self.select!r} and {self.threshold}"
            )

    @property
    def name(self) -> str:
        """``mipnerf360_goi``."""
        return "mipnerf360_goi"

    @property
    def version(self) -> int:
        """Raised when a change can move a number."""
        return VERSION

    def score(self, seen: Evidence) -> list[QueryScore]:
        """Score every labelled prompt of a view.

        Raises:
            ValueError: If sizes differ or a value is not finite.
        """
        return [compare(seen.view, unit, self._mask(seen, unit)) for unit in seen.units]

    def conclude(self, scores: Sequence[QueryScore], classes: Sequence[str]) -> Figures:
        """Mean over the images of each prompt, then over prompts: mIoU, mPA (pixel accuracy) and mP (precision)."""
        means = {
            "mask_accuracy": by_category(scores, lambda score: score.accuracy),
            "mask_precision": by_category(scores, lambda score: score.precision),
            "boundary_iou": by_category(scores, lambda score: score.boundary_iou),
        }
        more = {name: mean_of_known(values.values()) for name, values in means.items()}
        figures = without_localisation(self.name, scores, **more)
        return replace(figures, miou=mean_of_known(figures.per_category.values()))

    def _mask(self, seen: Evidence, unit: Unit) -> Bool[Tensor, "h w"]:
        maps = seen.levels(seen.cosines if self.select == "cosine" else seen.relevancy, unit)
        check_relevancy(self.name, maps, unit.category)
        if self.select == "cosine":
            return torch.amax(maps, dim=0) > self.threshold
        return select_level(maps, LANGSPLAT)[1]
