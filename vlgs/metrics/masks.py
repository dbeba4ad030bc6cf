"""Compares what one prompt selects in one view with the truth; every protocol averages these records."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.metrics.mean import mean_of_known
from vlgs.metrics.smooth import erode

BOUNDARY_SHARE = 0.02
"""Width of the boundary as a share of the image's diagonal (Cheng et al., CVPR 2021, Boundary IoU)."""


@dataclass(frozen=True)
class Unit:
    """The truth of one category in one view."""

    category: str
    mask: Bool[Tensor, "h w"]
    """Union of the instances."""
    boxes: Float[Tensor, "b 4"] | None = None
    """``(x1, y1, x2, y2)`` per instance, edges inclusive; None where there are none: then a hit is a pixel of the mask."""


@dataclass(frozen=True)
class QueryScore:
    """One category in one view: pixel counts, and what else its protocol measures. None is not available."""

    view: str
    category: str
    both: int
    """Pixels that are selected and true."""
    selected: int
    true: int
    pixels: int
    """All that were counted."""
    boundary_iou: float | None = None
    hit: bool | None = None
    """Localisation."""
    level: int | None = None
    """Which of several mask levels was segmented; None with one level, or where the protocol merges them."""

    @property
    def iou(self) -> float | None:
        """None if the truth is empty: an absent object can be neither found nor missed. 0 if only the selection is empty."""
        return self.both / (self.selected + self.true - self.both) if self.true else None

    @property
    def accuracy(self) -> float | None:
        """Share of pixels that are rightly selected or rightly left out; None where `iou` is."""
        wrong = self.selected + self.true - 2 * self.both
        return 1 - wrong / self.pixels if self.true else None

    @property
    def precision(self) -> float | None:
        """Share of the selected pixels that are true; None if nothing is selected or the truth is empty."""
        return self.both / self.selected if self.true and self.selected else None


def compare(
    view: str,
    unit: Unit,
    selected: Bool[Tensor, "h w"],
    hit: bool | None = None,
    level: int | None = None,
) -> QueryScore:
    """Count a selection against a unit.

    Raises:
        ValueError: If the sizes differ.
    """
    if selected.shape != unit.mask.shape:
        raise ValueError(
            f"metrics: selection of {unit.category!r} must be {list(unit.mask.shape)} like its mask, got {list(selected.shape)}"
        )
    return QueryScore(
        view,
        unit.category,
        both=int((selected & unit.mask).sum()),
        selected=int(selected.sum()),
        true=int(unit.mask.sum()),
        pixels=selected.numel(),
        boundary_iou=boundary_iou(selected, unit.mask),
        hit=hit,
        level=level,
    )


def intersection_over_union(
    selected: Bool[Tensor, "h w"], truth: Bool[Tensor, "h w"]
) -> float | None:
    """IoU of two masks; None if the truth is empty, 0 if only the selection is."""
    if not truth.any():
        return None
    return (selected & truth).sum().item() / (selected | truth).sum().item()


def boundary_iou(
    selected: Bool[Tensor, "h w"], truth: Bool[Tensor, "h w"], share: float = BOUNDARY_SHARE
) -> float | None:
    """IoU of the inner boundaries of two masks, `share` of the diagonal wide; None if the truth is empty.

    The image's own border counts as outside, as in the authors' code, so that a mask that fills the image has a boundary.
    """
    distance = max(1, round(share * math.hypot(*truth.shape)))
    return intersection_over_union(
        selected & ~erode(selected, distance), truth & ~erode(truth, distance)
    )


def mean_over_queries(
    scores: Iterable[QueryScore], value: Callable[[QueryScore], float | None]
) -> float | None:
    """Mean over all queries of a scene, a category counting as often as views show it."""
    return mean_of_known(value(score) for score in scores)


def by_category(
    scores: Sequence[QueryScore],
    value: Callable[[QueryScore], float | None] = lambda score: score.iou,
) -> Mapping[str, float | None]:
    """Mean over the queries of each category, in order of appearance."""
    groups: dict[str, list[QueryScore]] = {}
    for score in scores:
        groups.setdefault(score.category, []).append(score)
    return {category: mean_over_queries(group, value) for category, group in groups.items()}


def share_hit(scores: Iterable[QueryScore]) -> float | None:
    """Localisation accuracy: hits among the queries where it was tried."""
    return mean_of_known(None if score.hit is None else float(score.hit) for score in scores)
