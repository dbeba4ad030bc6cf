"""Nearest neighbours of a point cloud."""

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor


def mean_squared_distance(points: Float[Tensor, "n 3"], k: int = 3) -> Float[Tensor, " n"]:
    """Mean of the squared distances of every point to its k nearest other points; inf for a lone point.

    With fewer than k other points the mean is over those there are.

    Args:
        points: Finite positions.
        k: Neighbours to average over, at least 1.
    """
    n = points.shape[0]
    k = min(k, n - 1)
    if k < 1:
        return torch.full((n,), float("inf"), dtype=points.dtype)
    places = points.double().numpy()
    near = torch.from_numpy(KDTree(places).query(places, k=k + 1)[1])
    itself = near == torch.arange(n)[:, None]
    itself[:, -1] |= ~itself.any(dim=1)  # crowded out by others in its place, it is not among them
    squared = (points[:, None] - points[near]).square().sum(dim=-1)
    return squared[~itself].view(n, k).mean(dim=-1)
