"""Nearest neighbours of a point cloud."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor


def nearest(points: Float[Tensor, "n 3"], k: int) -> Int[Tensor, "n k"]:
    """Rows of the k nearest other points of every point; with fewer others, of all that there are.

    Args:
        points: Finite positions.
        k: At least 1.
    """
    n = points.shape[0]
    k = min(k, n - 1)
    if k < 1:
        return torch.zeros(n, 0, dtype=torch.int64)
    places = points.double().numpy()
    near = torch.from_numpy(KDTree(places).query(places, k=k + 1)[1])
    itself = near == torch.arange(n)[:, None]
    itself[:, -1] |= ~itself.any(dim=1)  # crowded out by others in its place, it is not among them
    return near[~itself].view(n, k)


def mean_squared_distance(points: Float[Tensor, "n 3"], k: int = 3) -> Float[Tensor, " n"]:
    """Mean of the squared distances of every point to its k nearest other points; inf for a lone point.

    With fewer than k other points the mean is over those there are.

    Args:
        points: Finite positions.
        k: Neighbours to average over, at least 1.
    """
    near = nearest(points, k)
    if not near.shape[1]:
        return torch.full((len(points),), float("inf"), dtype=points.dtype)
    return (points[:, None] - points[near]).square().sum(dim=-1).mean(dim=-1)


def pairs(near: Int[Tensor, "n k"]) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Every two points once of which at least one has the other among its nearest, in order: the smaller rows, the larger ones.

    Example:
        >>> pairs(torch.tensor([[1], [0], [1]]))
        (tensor([0, 1]), tensor([1, 2]))
    """
    n, k = near.shape
    one, other = torch.arange(n).repeat_interleave(k), near.flatten()
    both = (torch.minimum(one, other) * n + torch.maximum(one, other)).unique()
    return both.div(max(n, 1), rounding_mode="floor"), both.remainder(max(n, 1))
