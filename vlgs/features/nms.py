"""Non-maximum suppression: of boxes as SAM does it, of masks as LangSplat does it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Int64

from vlgs.features.masks import Mask, intersections


def box_nms(
    boxes: Int[np.ndarray, "n 4"], scores: Float[np.ndarray, " n"], threshold: float
) -> Int64[np.ndarray, " k"]:
    """Boxes that no better one which is kept overlaps by more than `threshold`, best first; equal scores keep their order.

    Args:
        boxes: ``(x1, y1, x2, y2)``, the last two exclusive.
        scores: Higher is better.
        threshold: Intersection over union, in [0, 1].
    """
    order = np.argsort(-scores, kind="stable")
    low, high = boxes[order, :2], boxes[order, 2:]
    areas = (high - low).prod(axis=1)
    alive = np.ones(len(order), bool)
    for i in range(len(order)):
        if not alive[i]:
            continue
        shared = np.minimum(high[i], high[i + 1 :]) - np.maximum(low[i], low[i + 1 :])
        both = shared.clip(0).prod(axis=1)
        alive[i + 1 :] &= both <= threshold * (areas[i] + areas[i + 1 :] - both)
    return order[alive]


@dataclass(frozen=True)
class MaskNms:
    """LangSplat's second suppression, in which every pair of masks counts, not only pairs of masks that stay.

    A mask goes if a better one overlaps it by more than `iou`; if its score is not above `score`; or if 85 % of it lie in
    another mask of which it covers less than half and the product of the two shares is below `inner`. Where a rule of the
    last two would leave nothing, the best three pass it.

    Args:
        iou: Intersection over union, in [0, 1].
        score: Of stability times predicted IoU.
        inner: In [0, 1].
    """

    iou: float = 0.8
    score: float = 0.7
    inner: float = 0.5

    def __call__(
        self, masks: Sequence[Mask], scores: Float[np.ndarray, " m"], size: tuple[int, int]
    ) -> Int64[np.ndarray, " k"]:
        """Positions of the masks that stay, rising.

        Args:
            masks: Candidates of one level.
            scores: Stability times predicted IoU.
            size: Height and width of the photograph.
        """
        if not masks:
            return np.zeros(0, np.int64)
        common = intersections(masks, size)
        areas = common.diagonal()
        rank = np.empty(len(masks), np.int64)
        rank[np.argsort(-scores, kind="stable")] = np.arange(len(masks))
        better = rank[:, None] < rank[None, :]
        overlap = common / (areas[:, None] + areas[None, :] - common)
        of_row, of_column = common / areas[:, None], common / areas[None, :]
        within = (of_column >= 0.85) & (of_row < 0.5) & (of_row * of_column < self.inner)
        first = rank < 3
        keep = ~((overlap > self.iou) & better).any(axis=0)
        for passed in (
            scores > self.score,
            ~(within & better).any(axis=0),
            ~(within & ~better).any(axis=0),
        ):
            keep &= passed if passed.any() else first
        return np.flatnonzero(keep)
