"""Rays of pixels, samples along them, and what each sample weighs. Distances are along unit directions."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from vlgs.geometry import camera_center
from vlgs.types import Camera, DepthKind


@dataclass(frozen=True)
class Rays:
    """Half-lines of pixels."""

    origins: Float[Tensor, "r 3"]
    directions: Float[Tensor, "r 3"]
    """Unit length."""
    near: Float[Tensor, " r"] | None = None
    """Distances before which nothing is looked for; None: those of `Spacing`."""

    def points(self, distances: Float[Tensor, "r s"]) -> Float[Tensor, "r s 3"]:
        """Where they are at distances from their origins."""
        return self.origins[:, None] + self.directions[:, None] * distances[..., None]


def pixel_rays(camera: Camera, pixels: Int[Tensor, " r"]) -> Rays:
    """Rays through the middles of pixels, counted row by row, in world units."""
    x, y = pixels % camera.width + 0.5, pixels // camera.width + 0.5
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    ahead = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], dim=-1)
    directions = normalize(ahead.to(camera.viewmat) @ camera.viewmat[:3, :3], dim=-1)
    return Rays(camera_center(camera.viewmat).expand_as(directions), directions)


@dataclass(frozen=True)
class Spacing:
    """Distances between two bounds in even steps, then to infinity in even steps of their inverse.

    Raises:
        ValueError: If the bounds are not 0 < near < far.
    """

    near: float
    """Nothing is looked for nearer to a camera."""
    far: float
    """Where the even steps end."""
    share: float = 0.75
    """Of the steps that are even."""
    horizon: float = 1e3
    """The last distance, in units of `far`."""

    def __post_init__(self) -> None:
        if not 0 < self.near < self.far:
            raise ValueError(
                f"spacing: near must be above 0 and below far ({self.far}), got {self.near}"
            )

    def __call__(
        self, steps: Float[Tensor, "*n"], near: Float[Tensor, "..."] | None = None
    ) -> Float[Tensor, "*n"]:
        """Distances of steps in [0, 1], perhaps with a nearest distance of each ray's own.

        Example:
            >>> Spacing(1.0, 4.0, 0.5)(torch.tensor([0.0, 0.25, 0.5, 0.75]))
            tensor([1.0000, 2.5000, 4.0000, 7.9920])
        """
        first = (
            torch.as_tensor(self.near) if near is None else near.clamp(self.near, 0.9 * self.far)
        )
        even = first + (self.far - first) * steps / self.share
        beyond = ((steps - self.share) / (1 - self.share)).clamp(0, 1)
        inverse = (1 - beyond) / self.far + beyond / (self.far * self.horizon)
        return torch.where(steps < self.share, even, 1 / inverse)


def nearest_seen(
    camera: Camera, points: Float[Tensor, "p 3"], cells: int = 16
) -> Float[Tensor, "cells cells"]:
    """Distance of the nearest point that a camera sees in or beside each cell of a coarse raster; 0 where there is none.

    Args:
        camera: Where to look from.
        points: Of the world, on surfaces.
        cells: Of the raster along each axis.
    """
    seen = points.to(camera.viewmat) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    image = seen @ camera.K.to(seen).T
    size = seen.new_tensor([camera.width, camera.height])
    place = (image[:, :2] / image[:, 2:].clamp_min(1e-9) / size * cells).floor()
    inside = (image[:, 2] > 0) & (place >= 0).all(1) & (place < cells).all(1)
    x, y = place[inside].long().unbind(1)
    closeness = seen.new_zeros(cells * cells)
    closeness.scatter_reduce_(
        0, y * cells + x, 1 / seen[inside].norm(dim=1).clamp_min(1e-9), "amax"
    )
    around = max_pool2d(closeness.view(1, cells, cells), kernel_size=3, stride=1, padding=1)[0]
    return torch.where(around > 0, 1 / around, 0.0)


def importance(
    edges: Float[Tensor, "r c"],
    weights: Float[Tensor, "r k"],
    draws: Float[Tensor, "r n"],
) -> Float[Tensor, "r n"]:
    """Places that are dense where weights are large: the inverse of their distribution function.

    Args:
        edges: Bounds of k = c - 1 intervals, ascending.
        weights: Of each interval, not negative and not all zero; within one, places are even.
        draws: Ascending, in [0, 1].
    """
    share = weights / weights.sum(dim=-1, keepdim=True)
    reached = torch.cat([torch.zeros_like(share[:, :1]), share.cumsum(dim=-1)], dim=-1)
    upper = torch.searchsorted(reached, draws.contiguous(), right=True).clamp(1, weights.shape[1])
    low, high = reached.gather(1, upper - 1), reached.gather(1, upper)
    within = ((draws - low) / (high - low).clamp_min(1e-9)).clamp(0, 1)
    start, end = edges.gather(1, upper - 1), edges.gather(1, upper)
    return start + within * (end - start)


def ray_weights(
    density: Float[Tensor, "r s"], lengths: Float[Tensor, "r s"]
) -> Float[Tensor, "r s"]:
    """Share of each interval in what a ray sees: ``w_i = (1 - exp(-d_i l_i)) exp(-sum_(j<i) d_j l_j)`` (Mildenhall et al., NeRF).

    Example:
        >>> ray_weights(torch.tensor([[2.0, 1.0]]).log(), torch.ones(1, 2))
        tensor([[0.5000, 0.0000]])
    """
    depth = density * lengths
    before = torch.cat([torch.zeros_like(depth[:, :1]), depth[:, :-1].cumsum(dim=-1)], dim=-1)
    return -torch.expm1(-depth) * torch.exp(-before)


def ray_depth(
    distances: Float[Tensor, "r s"], weights: Float[Tensor, "r s"], kind: DepthKind
) -> Float[Tensor, " r"]:
    """How far rays see: the sum of w_i d_i, the mean, or the first distance up to which half is seen, 0 without.

    Example:
        >>> seen = torch.tensor([[1.0, 2.0, 4.0]]), torch.tensor([[0.25, 0.25, 0.3]])
        >>> [ray_depth(*seen, kind).item() for kind in ("accumulated", "expected", "median")]
        [1.9500000476837158, 2.4375, 2.0]
    """
    if kind == "median":
        reached = weights.cumsum(dim=-1) >= 0.5
        first = distances.gather(1, reached.int().argmax(dim=1, keepdim=True))[:, 0]
        return torch.where(reached.any(dim=1), first, 0.0)
    total = (weights * distances).sum(dim=1)
    return total if kind == "accumulated" else total / weights.sum(dim=1).clamp_min(1e-9)


def spread(edges: Float[Tensor, "r c"], weights: Float[Tensor, "r k"]) -> Float[Tensor, ""]:
    """Mean distance, over rays, of two places that a ray sees (the distortion loss of Mip-NeRF 360, whose integrals are exact here).

    Args:
        edges: Of the intervals, ascending.
        weights: Of each interval.
    """
    middles, lengths = (edges[:, 1:] + edges[:, :-1]) / 2, edges.diff(dim=-1)
    # Of ascending places: sum_ij w_i w_j |m_i - m_j| = 2 sum_i w_i (m_i W_i - M_i), with sums over those before.
    moments = weights * middles
    mass, moment = weights.cumsum(-1) - weights, moments.cumsum(-1) - moments
    between = 2 * (weights * (middles * mass - moment)).sum(-1)
    within = (weights.square() * lengths).sum(-1) / 3
    return (between + within).mean()
