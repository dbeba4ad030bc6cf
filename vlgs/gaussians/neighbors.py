"""Exact nearest neighbours of a point cloud in bounded memory, without a tree of Python objects."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

LEAF = 64
"""Points per leaf at most; measured best between 64 and 128."""
CHUNK = 1 << 22
"""Distances that are held at once."""


def mean_squared_distance(points: Float[Tensor, "n 3"], k: int = 3) -> Float[Tensor, " n"]:
    """Mean of the squared distances of every point to its k nearest other points; inf for a lone point.

    With fewer than k other points the mean is over those there are. The points are cut at medians into leaves; a leaf
    then meets the other leaves in the order of the distance between their boxes, and stops when no nearer point can
    come. The result is exact, the time grows about as n log n for points on surfaces, and the memory stays bounded.

    Args:
        points: Finite positions.
        k: Neighbours to average over, at least 1.
    """
    n = points.shape[0]
    k = min(k, n - 1)
    if k < 1:
        return torch.full((n,), float("inf"), dtype=points.dtype)
    leaves = _split_at_medians(points)
    nearest = _nearest_squared(leaves, k)  # [b, m, k]
    result = points.new_empty(n)
    result[leaves.index[leaves.real]] = nearest.mean(dim=-1)[leaves.real]
    return result


@dataclass(frozen=True)
class _Leaves:
    """b leaves of m points each."""

    index: Int[Tensor, "b m"]
    """Row of the point cloud."""
    real: Bool[Tensor, "b m"]
    """False for copies that only fill up the last places."""
    points: Float[Tensor, "b m 3"]


def _split_at_medians(points: Float[Tensor, "n 3"]) -> _Leaves:
    """Halve along the widest axis of each part until the parts have at most `LEAF` points."""
    n = points.shape[0]
    count = 1
    while count * LEAF < n:
        count *= 2
    size = -(-n // count)
    order = torch.arange(count * size)[None]
    while order.shape[0] < count:
        part = points[order.clamp_max(n - 1)]  # [b, m, 3]
        widest = (part.amax(dim=1) - part.amin(dim=1)).argmax(dim=-1)
        values = part.gather(2, widest[:, None, None].expand(-1, part.shape[1], 1)).squeeze(-1)
        order = order.gather(1, values.argsort(dim=1, stable=True))
        order = order.reshape(2 * order.shape[0], -1)
    index = order.clamp_max(n - 1)
    return _Leaves(index, order < n, points[index])


def _nearest_squared(leaves: _Leaves, k: int) -> Float[Tensor, "b m {k}"]:
    blocks = leaves.points.shape[0]
    low, high = leaves.points.amin(dim=1), leaves.points.amax(dim=1)
    step = max(1, CHUNK // max(blocks * 3, LEAF * LEAF * 3))
    rows = torch.arange(blocks).split(step)
    return torch.cat([_nearest_of_rows(leaves, low, high, row, k) for row in rows])


def _nearest_of_rows(
    leaves: _Leaves,
    low: Float[Tensor, "b 3"],
    high: Float[Tensor, "b 3"],
    rows: Int[Tensor, " r"],
    k: int,
) -> Float[Tensor, "r m {k}"]:
    """The k smallest squared distances of all points of some leaves, each leaf visiting the others box by box."""
    gap = (low[None] - high[rows, None]).clamp_min(0) + (low[rows, None] - high[None]).clamp_min(0)
    bound, visit = (
        gap.square().sum(dim=-1).sort(dim=1)
    )  # [r, b], the leaf itself or an overlapping one first
    size = leaves.points.shape[1]
    best = leaves.points.new_full((rows.numel(), size, k), float("inf"))
    active = torch.arange(rows.numel())
    for turn in range(visit.shape[1]):
        reach = best[active].amax(dim=(1, 2))
        active = active[bound[active, turn] < reach]
        if active.numel() == 0:
            break
        mine, other = rows[active], visit[active, turn]
        offsets = leaves.points[mine, :, None] - leaves.points[other, None]  # [a, m, m, 3]
        squared = offsets.square().sum(dim=-1)
        same = leaves.index[mine, :, None] == leaves.index[other, None]
        squared.masked_fill_(same | ~leaves.real[other, None], float("inf"))
        merged = torch.cat([best[active], squared], dim=-1)
        best[active] = merged.topk(k, dim=-1, largest=False).values
    return best
