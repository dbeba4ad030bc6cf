"""Gaussians behind everything, so that no ray ends in nothing.

Structure from motion finds no points on skies and plain walls. Without Gaussians behind everything, training fits such pixels with
large, faint Gaussians close to the cameras. These fit every training view and appear as fog in all others. And an unseen view
that looks where no training view looked would show black.

Where there are points the background stands not far behind them. Training makes what is in front of it half transparent, and
corrects the colour with what shines through; the farther behind that is, the less the two fit together from another place.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from vlgs.gaussians.attributes import Attributes
from vlgs.gaussians.config import GaussiansConfig
from vlgs.gaussians.init import Cloud, parameters_of
from vlgs.geometry import camera_center, scene_extent
from vlgs.types import Camera, Scene

CELLS = (4, 16)
"""Smallest and largest number of squares across the longer side of a view; the number is half the square root of the points in it."""
CAMERA_SHARE, POINT_SHARE = 10.0, 2.0
"""Far is the larger of so many scene extents and so many times the distance within which 19 of 20 points lie."""
BEHIND, CONE, FEWEST = 1.5, 0.2, 3
"""In a direction with at least `FEWEST` points within `CONE` radians, the background is `BEHIND` times as far as 19 of 20 of them."""
MAX_VIEWS = 64
"""Views that are looked through, evenly chosen."""
MAX_POINTS = 1 << 17
"""Points that are looked for in a view, evenly chosen."""
MAX_NEAR = 1 << 14
"""Points that are looked for in a direction, evenly chosen."""


def with_background(
    parameters: dict[str, Tensor], scene: Scene, config: GaussiansConfig, attributes: Attributes
) -> dict[str, Tensor]:
    """The first Gaussians and, behind them, round ones all around cameras and scene.

    A scene without sparse points gets none: its random ones are everywhere already.

    Args:
        parameters: From `initialise`.
        scene: Its training views and sparse points.
        config: How many directions all around, and how opaque the background starts. What no training view sees stays so: at the opacity
            of other Gaussians an unseen view that looks there is dark.
        attributes: What the Gaussians carry.
    """
    sphere = background(scene, config.background)
    if len(sphere.points) == 0:
        return parameters
    middle = _cameras(scene)[0].mean(dim=0)
    # The distance of neighbours on a sphere of this many directions.
    scales = (sphere.points - middle).norm(dim=1) * math.sqrt(4 * math.pi / config.background)
    behind = parameters_of(sphere, scales, attributes)
    if config.background_opacity is not None:
        start = torch.tensor(config.background_opacity).logit()
        behind["opacity_logits"] = start.expand_as(behind["opacity_logits"]).clone()
    return {name: torch.cat([value, behind[name]]) for name, value in parameters.items()}


def background(scene: Scene, count: int) -> Cloud:
    """Points behind the scene in evenly spread directions from the middle of the cameras, and the colours that training views have there.

    A direction has the mean colour of the views that look past every sparse point there, if most that look into it do. Other
    directions have the colour of the nearest such one: what hides the sky in them is not the colour of the sky. Where there is none at
    all, in a room with points on every wall, the mean of all views that look into a direction has to do.
    """
    points = scene.points.float()
    points = points[points.isfinite().all(dim=1)]
    points = points[:: -(-len(points) // MAX_POINTS) or 1]
    if count == 0 or len(points) == 0:
        return Cloud(points[:0], points[:0])
    centers, extent = _cameras(scene)
    middle = centers.mean(dim=0)
    within = (points - middle).norm(dim=1).quantile(0.95).item()
    far = max(CAMERA_SHARE * extent, POINT_SHARE * within)
    directions = _directions(count)
    sphere = middle + far * directions
    seen, past = torch.zeros(count), torch.zeros(count)
    total, sky = torch.zeros(count, 3), torch.zeros(count, 3)
    for view in scene.train[:: -(-len(scene.train) // MAX_VIEWS)]:
        x, y, inside = _project(sphere, view.camera)
        pixels = view.read_image()[y[inside].long(), x[inside].long()].float() / 255.0
        free = _beside_points(points, view.camera, x[inside], y[inside])
        seen += inside
        total[inside] += pixels
        past[inside] += free
        sky[inside] += pixels * free[:, None]
    if not seen.any():  # cameras that see nothing of the sphere: of a huge focal length, or a principal point far out
        return Cloud(points[:0], points[:0])
    known = 2 * past > seen
    reach = _reach(points - middle, directions).clamp(extent, far).masked_fill(known, far)
    # Near a camera it would stand before the lens of an unseen view.
    near = torch.cdist(reach[:, None] * directions, centers - middle).amin(dim=1) < extent / 2
    reach = reach.masked_fill(near, far)
    if not known.any():
        known, past, sky = seen > 0, seen, total
    nearest = torch.cdist(sphere, sphere[known]).argmin(dim=1)
    colors = (sky[known] / past[known][:, None])[nearest]
    return Cloud(middle + reach[:, None] * directions, colors)


def _cameras(scene: Scene) -> tuple[Float[Tensor, "v 3"], float]:
    """Centres of the training cameras, and the scene extent: none is farther from their mean."""
    viewmats = torch.stack([view.camera.viewmat for view in scene.train]).float()
    return camera_center(viewmats), scene_extent(viewmats)


def _reach(
    points: Float[Tensor, "n 3"], directions: Float[Tensor, "count 3"]
) -> Float[Tensor, " count"]:
    """Distance from the origin to the background behind the points, infinite in directions without points."""
    points = points[:: -(-len(points) // MAX_NEAR)]
    distances = points.norm(dim=1)
    reach = torch.full((len(directions),), torch.inf)
    for number, direction in enumerate(directions):
        ahead = distances[points @ direction > math.cos(CONE) * distances]
        if len(ahead) >= FEWEST:
            reach[number] = BEHIND * ahead.quantile(0.95)
    return reach


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
    """Whether no sparse point lies in the square of a pixel, or in one beside it."""
    at_x, at_y, inside = _project(points, camera)
    cells = min(max(math.sqrt(int(inside.sum())) / 2, CELLS[0]), CELLS[1])
    size = max(camera.width, camera.height) / cells
    rows, columns = math.ceil(camera.height / size), math.ceil(camera.width / size)
    taken = torch.zeros(1, rows, columns)
    taken[0, (at_y[inside] / size).long(), (at_x[inside] / size).long()] = 1
    taken = max_pool2d(taken, 3, stride=1, padding=1)[0] > 0
    return ~taken[(y / size).long(), (x / size).long()]
