"""Groups the masks of all views into objects, from the Gaussians that are blended into them."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from torch import Tensor

from vlgs.training.mask_weights import MaskWeights

ROWS = 1024
"""Groups that are compared with all others at once: bounds the memory."""


def group_masks(
    sums: MaskWeights, views: Int[Tensor, " m"], overlaps: Sequence[float]
) -> Int[Tensor, " m"]:
    """Group of every mask, from 0; -1 for masks that no Gaussian belongs to.

    A Gaussian belongs to the mask of a view that has more than half of its weight in the masks of that view. With e that weight, two masks of different
    views share the sum of ``sqrt(e e')`` over the Gaussians that belong to both. Divided by that over the Gaussians which belong to either and which both
    views show, this is their intersection over union: 1 for one object, whatever hides parts of it in one view.

    Groups begin as single masks. Two that are each other's best partner become one, as long as the pooled intersection over union of
    their masks is high enough, so that a mask with a fault is outvoted. This is done for each bound of `overlaps`, the surest groups first. In
    between, Gaussians are explained away: one that is mostly shown by another group counts for little. What lies behind a glass is in each of its
    masks, and in every view it is something else; without this step the masks of a glass have nothing in common.

    Args:
        sums: Per Gaussian and mask the blending weight.
        views: Number of the view of every mask.
        overlaps: Least intersection over union of two groups that become one, one bound after the other.
    """
    belonging = _Belonging(sums, views)
    group = np.arange(len(views))
    for look, least in enumerate(overlaps):
        shared, within, where = belonging.compare(group, explain=look > 0)
        while True:
            partner, best = _partners(shared, within, where)
            rows = np.arange(len(partner))
            mutual = (partner >= 0) & (best >= least) & (partner[partner] == rows)
            if not mutual.any():
                break
            _, new = np.unique(
                np.where(mutual, np.minimum(partner, rows), rows), return_inverse=True
            )
            group, merge = new[group], _sums_of(new)
            shared = (merge @ shared @ merge.T).tocsr()
            within, where = merge @ within, merge @ where
    return torch.from_numpy(np.where(belonging.empty, -1, group))


class _Belonging:
    """Which Gaussians belong to which masks: a list of pairs."""

    def __init__(self, sums: MaskWeights, views: Int[Tensor, " m"]) -> None:
        gaussian, mask = sums.gaussian.numpy(), sums.mask.numpy()
        weight = sums.weight.double().numpy()
        self.view = views.numpy()
        self.views = int(self.view.max()) + 1
        self.shape = (sums.gaussians, len(views))
        seen = gaussian * self.views + self.view[mask]
        _, place = np.unique(seen, return_inverse=True)
        e = np.bincount(place, weights=weight)[place]
        most = weight > e / 2
        self.gaussian, self.mask, self.weight = gaussian[most], mask[most], weight[most]
        self.root = np.sqrt(e[most])

    @property
    def empty(self) -> Bool[np.ndarray, " m"]:
        """Masks without a Gaussian."""
        return np.bincount(self.mask, minlength=self.shape[1]) == 0

    def compare(
        self, group: Int[np.ndarray, " m"], explain: bool
    ) -> tuple[csr_matrix, Float[np.ndarray, "g views"], Float[np.ndarray, "g views"]]:
        """What groups share, what each view shows of them, and how many of their masks it has; `explain` away the Gaussians of others."""
        own = 1.0 - self._share_of_others(group) * explain
        merge = _sums_of(group)
        at = (self.gaussian, self.mask)
        belongs = csr_matrix((self.root * own, at), self.shape) @ merge.T
        counted = csr_matrix((self.root * own**2, at), self.shape) @ merge.T
        shown = csr_matrix(
            (self.root, (self.gaussian, self.view[self.mask])), (self.shape[0], self.views)
        )
        where = (self.view[:, None] == np.arange(self.views)).astype(float)
        return (belongs.T @ belongs).tocsr(), (counted.T @ shown).toarray(), merge @ where

    def _share_of_others(self, group: Int[np.ndarray, " m"]) -> Float[np.ndarray, " z"]:
        """Per pair, the largest share of the Gaussian's weight that a single other group has."""
        shape = (self.shape[0], int(group.max()) + 1)
        total = csr_matrix((self.weight, (self.gaussian, group[self.mask])), shape).tocoo()
        order = np.lexsort((total.col, np.negative(total.data), total.row))
        row, column, weight = total.row[order], total.col[order], total.data[order]
        rows, first = np.unique(row, return_index=True)
        most, best, second = np.full(shape[0], -1), np.zeros(shape[0]), np.zeros(shape[0])
        most[rows], best[rows] = column[first], weight[first]
        again = first[np.diff(np.append(first, len(row))) > 1] + 1
        second[row[again]] = weight[again]
        everything = np.bincount(self.gaussian, weights=self.weight, minlength=shape[0])
        owner = most[self.gaussian] == group[self.mask]
        other: np.ndarray = np.where(owner, second[self.gaussian], best[self.gaussian])
        return other / everything[self.gaussian]


def _sums_of(group: Int[np.ndarray, " m"]) -> csr_matrix:
    """Sums rows of masks into those of groups."""
    return csr_matrix((np.ones(len(group)), (group, np.arange(len(group)))))


def _partners(
    shared: csr_matrix, within: Float[np.ndarray, "g views"], where: Float[np.ndarray, "g views"]
) -> tuple[Int[np.ndarray, " g"], Float[np.ndarray, " g"]]:
    """The other group with which each has the largest intersection over union, the first of equal ones, and how large it is; -1 where there is none."""
    partner, best = np.full(len(within), -1), np.zeros(len(within))
    for first in range(0, len(within), ROWS):
        block = slice(first, first + ROWS)
        both = shared[block].toarray()
        either = within[block] @ where.T + where[block] @ within.T - both
        overlap = both / np.maximum(either, np.finfo(float).tiny)
        rows = np.arange(len(overlap))
        overlap[rows, rows + first] = 0
        partner[block], best[block] = overlap.argmax(axis=1), overlap.max(axis=1)
    partner[best == 0] = -1
    return partner, best
