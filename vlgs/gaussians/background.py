"""Far Gaussians where training views look past every sparse point: a sky, a plain wall.

Structure from motion finds no points there. Without Gaussians behind everything, training explains such pixels by what it has:
large, faint ones close to the cameras, which fit every training view and fog all others.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from vlgs.gaussians.config import GaussiansConfig
from vlgs.gaussians.init import Cloud, parameters_of
from vlgs.gaussians.neighbors import mean_squared_distance
from vlgs.gaussians.parameters import logit
from vlgs.geometry import camera_center, scene_extent
from vlgs.types import Camera, Scene

CELLS = (4, 16)
"""A view is looked through in squares, so many across its longer side: half the square root of the points in it, within these."""
CAMERA_SHARE, POINT_SHARE = 10.0, 2.0
"""Radius of the sphere: the larger of so many scene extents and so many times the distance within which 19 of 20 points lie."""
MAX_VIEWS = 64
"""Views that are looked through, evenly chosen."""
MAX_POINTS = 1 << 17
"""Points that are looked for in a view, evenly chosen."""


def with_background(
    parameters: dict[str, Tensor], scene: Scene, config: GaussiansConfig
) -> dict[str, Tensor]:
    """The first Gaussians and, behind them, round ones on a sphere around cameras and scene, where views look past every sparse point.

    A closed room with points on every wall gets none; nor does a scene without sparse points, where nothing is known to be empty.
    Elsewhere the sphere is closed: directions that no view looks into have the colour of the nearest one that a view does.

    Args:
        parameters: From `initialise`.
        scene: Its training views and sparse points.
        config: `background` directions all around, and their opacity.
    """
    sphere = background(scene, config.background)
    if len(sphere.points) == 0:
        return parameters
    scales = mean_squared_distance(sphere.points).sqrt()
    behind = parameters_of(sphere, scales, config, parameters["features"].shape[1])
    behind["opacity_logits"].fill_(logit(config.background_opacity))
    return {name: torch.cat([value, behind[name]]) for name, value in parameters.items()}


def background(scene: Scene, count: int) -> Cloud:
    """Evenly spread points of the sphere and the mean colours of the views there; none where there is nothing to be seen past."""
    points = scene.points.float()
    points = points[points.isfinite().all(dim=1)]
    points = points[:: -(-len(points) // MAX_POINTS) or 1]
    nothing = Cloud(points[:0], points[:0])
    if count == 0 or len(points) == 0:
        return nothing
    viewmats = torch.stack([view.camera.viewmat for view in scene.train]).float()
    middle = camera_center(viewmats).mean(dim=0)
    within = (points - middle).norm(dim=1).quantile(0.95).item()
    radius = max(CAMERA_SHARE * scene_extent(viewmats), POINT_SHARE * within)
    sphere = middle + radius * _directions(count)
    seen, empty, color = torch.zeros(count), torch.zeros(count), torch.zeros(count, 3)
    for view in scene.train[:: -(-len(scene.train) // MAX_VIEWS)]:
        x, y, inside = _project(sphere, view.camera)
        free = _beside_points(points, view.camera, x, y) & inside
        seen += inside
        empty += free
        color[free] += view.read_image()[y[free].long(), x[free].long()].float() / 255.0
    known = 2 * empty > seen
    if not known.any():
        return nothing
    nearest = torch.cdist(sphere, sphere[known]).argmin(dim=1)
    return Cloud(sphere, (color[known] / empty[known][:, None])[nearest])


def _directions(count: int) -> Float[Tensor, "count 3"]:
    """A sunflower around a sphere: even, and without a random draw."""
    turn = torch.arange(count) + 0.5
    z, angle = 1 - 2 * turn / count, math.pi * (1 + math.sqrt(5)) * turn
    flat = (1 - z.square()).sqrt()
    return torch.stack([flat * angle.cos(), flat * angle.sin(), z], dim=1)


def _project(
    points: Float[Tensor, "n 3"], camera: Camera
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Pixel coordinates, and whether a point is in front of the camera and within its image."""
    viewmat, K = camera.viewmat.float(), camera.K.float()
    x, y, depth = ((points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T).unbind(-1)
    x, y = x / depth, y / depth
    inside = (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return x, y, inside


def _beside_points(
    points: Float[Tensor, "n 3"], camera: Camera, x: Float[Tensor, " m"], y: Float[Tensor, " m"]
) -> Bool[Tensor, " m"]:
    """Whether no sparse point lies in the square of a pixel or in one beside it; what is outside of the image may be anything."""
    at_x, at_y, inside = _project(points, camera)
    cells = min(max(math.sqrt(int(inside.sum())) / 2, CELLS[0]), CELLS[1])
    size = max(camera.width, camera.height) / cells
    rows, columns = math.ceil(camera.height / size), math.ceil(camera.width / size)
    taken = torch.zeros(1, rows, columns)
    taken[0, (at_y[inside] / size).long(), (at_x[inside] / size).long()] = 1
    taken = max_pool2d(taken, 3, stride=1, padding=1)[0] > 0
    row = (y / size).nan_to_num().clamp(0, rows - 1).long()
    column = (x / size).nan_to_num().clamp(0, columns - 1).long()
    return ~taken[row, column]
