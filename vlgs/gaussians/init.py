"""The first Gaussians of a scene: one per sparse point, or random ones where the cameras look."""

import logging
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vlgs.gaussians.attributes import Attributes
from vlgs.gaussians.config import GaussiansConfig
from vlgs.gaussians.draws import seeded_generator
from vlgs.gaussians.neighbors import mean_squared_distance
from vlgs.gaussians.parameters import conform
from vlgs.gaussians.sh import rgb_to_sh
from vlgs.geometry import camera_center, scene_extent
from vlgs.types import Camera, Scene

log = logging.getLogger(__name__)

MIN_CAMERA_DISTANCE = 1e-2
"""Points nearer than this to a training camera, in world units, are measurement errors that would fill its view."""
MAX_COORDINATE = 1e12
"""Points beyond this are as broken as a NaN: the squares of their distances leave float32."""
MIN_SQUARED_DISTANCE = 1e-7
"""Floor of the mean squared distance to the neighbours (3DGS)."""
OVERSAMPLING = 4
"""Random candidates per random point that is kept."""
DEPTHS = (0.1, 10.0)
"""Range of random depths, as shares of the scene extent."""


@dataclass(frozen=True)
class Cloud:
    """Points with their colours in [0, 1]."""

    points: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]


def initialise(
    scene: Scene, config: GaussiansConfig, attributes: Attributes, seed: int = 0
) -> dict[str, Tensor]:
    """Raw parameters of the first Gaussians (as in 3DGS).

    Each sparse point becomes an isotropic Gaussian whose variance is the mean squared distance to its three nearest
    neighbours, clamped at 1e-7 below and by `GaussiansConfig.max_init_angle` above. Non-finite points, points on a
    camera and exact duplicates are left out. Without sparse points, random ones fill the volume that most training
    cameras see.

    Args:
        scene: With at least one training view.
        config: How many points there may be, and how large.
        attributes: What the Gaussians carry, and how it starts where points say nothing; codes at zero (conf/README.md, D.9).
        seed: Decides the random points, and which ones are kept when there are more than `max_count`.

    Raises:
        ValueError: If there is no training view.
    """
    if not scene.train:
        raise ValueError(f"gaussians: scene {scene.name} must have training views, got none")
    cameras = [view.camera for view in scene.train]
    centers = camera_center(torch.stack([camera.viewmat for camera in cameras])).float()
    generator = seeded_generator("initialise", seed, 0)
    cloud = _usable(Cloud(scene.points.float(), scene.point_colors.float() / 255.0), centers)
    if cloud.points.shape[0] == 0:
        log.info("%s has no usable sparse points: %d random ones", scene.name, config.init_points)
        points = _random_points(cameras, min(config.init_points, config.max_count), generator)
        cloud = Cloud(points, torch.full_like(points, 0.5))
    elif cloud.points.shape[0] > config.max_count:
        log.info("%d of %d sparse points kept", config.max_count, cloud.points.shape[0])
        kept = torch.randperm(cloud.points.shape[0], generator=generator)[
            : config.max_count
        ].sort()[0]
        cloud = Cloud(cloud.points[kept], cloud.colors[kept])
    return parameters_of(cloud, _initial_scales(cloud.points, centers, config), attributes)


def parameters_of(
    cloud: Cloud, scales: Float[Tensor, " n"], attributes: Attributes
) -> dict[str, Tensor]:
    """Raw parameters of round Gaussians of these scales."""
    n = cloud.points.shape[0]
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    given = {
        "means": cloud.points.clone(),
        "quats": quats,
        "log_scales": scales.log()[:, None].repeat(1, 3),
        "sh0": rgb_to_sh(cloud.colors),
    }
    return conform(given, attributes)


def _usable(cloud: Cloud, centers: Float[Tensor, "v 3"]) -> Cloud:
    finite = (cloud.points.abs() <= MAX_COORDINATE).all(dim=1)  # false for NaN
    points, colors = cloud.points[finite], cloud.colors[finite]
    points, first = _without_duplicates(points)
    colors = colors[first]
    clear = distance_to_nearest(points, centers) >= MIN_CAMERA_DISTANCE
    return Cloud(points[clear], colors[clear])


def _without_duplicates(
    points: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "m 3"], Int[Tensor, " m"]]:
    """The first of every set of equal points, in the order they came, and their rows."""
    _, group = torch.unique(points, dim=0, return_inverse=True)
    rows = torch.arange(points.shape[0])
    first = torch.full_like(rows, points.shape[0]).scatter_reduce(0, group, rows, "amin")
    first = first[first < points.shape[0]].sort()[0]
    return points[first], first


def distance_to_nearest(
    points: Float[Tensor, "n 3"], centers: Float[Tensor, "v 3"]
) -> Float[Tensor, " n"]:
    """Distance of every point to the nearest centre."""
    # In chunks, and without the matrix product that loses small distances to cancellation.
    exact = "donot_use_mm_for_euclid_dist"
    chunks = points.split(1 << 14)
    return torch.cat([torch.cdist(c, centers, compute_mode=exact).amin(dim=1) for c in chunks])


def _initial_scales(
    points: Float[Tensor, "n 3"], centers: Float[Tensor, "v 3"], config: GaussiansConfig
) -> Float[Tensor, " n"]:
    scales = mean_squared_distance(points).clamp_min(MIN_SQUARED_DISTANCE).sqrt()
    return scales.minimum(config.max_init_angle * distance_to_nearest(points, centers))


def _random_points(
    cameras: list[Camera], count: int, generator: torch.Generator
) -> Float[Tensor, "count 3"]:
    """Points on random rays of random cameras, at log-uniform depths; those that most cameras see are kept."""
    extent = scene_extent(torch.stack([camera.viewmat for camera in cameras]))
    draws = OVERSAMPLING * count
    chosen = torch.randint(len(cameras), (draws,), generator=generator)
    u, v, w = torch.rand(3, draws, generator=generator)
    depth = extent * DEPTHS[0] * (DEPTHS[1] / DEPTHS[0]) ** w
    points = torch.empty(draws, 3)
    for index, camera in enumerate(cameras):
        own, viewmat, K = chosen == index, camera.viewmat.float(), camera.K.float()
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        x = (u[own] * camera.width - cx) / fx * depth[own]
        y = (v[own] * camera.height - cy) / fy * depth[own]
        in_camera = torch.stack([x, y, depth[own]], dim=1)
        points[own] = (in_camera - viewmat[:3, 3]) @ viewmat[:3, :3]
    seen = torch.stack([in_view(points, camera) for camera in cameras]).sum(dim=0)
    # A stable sort leaves equally visible candidates in their random order.
    return points[seen.argsort(descending=True, stable=True)[:count]]


def in_view(points: Float[Tensor, "n 3"], camera: Camera) -> Bool[Tensor, " n"]:
    """Which points lie in front of the camera and within its image."""
    viewmat, K = camera.viewmat.float(), camera.K.float()
    in_camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y, depth = (in_camera @ K.T).unbind(-1)
    inside = (x >= 0) & (x <= camera.width * depth) & (y >= 0) & (y <= camera.height * depth)
    return inside & (depth > 0)
