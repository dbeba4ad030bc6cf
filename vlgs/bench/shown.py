"""Which pixels of a held-out view show a surface that a training photograph shows too. What no photograph shows, nobody can know."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from omegaconf import DictConfig
from torch import Tensor

from vlgs.data.synthetic.capture import Capture, Shot, open_capture
from vlgs.data.synthetic.photographs import pixel_rays
from vlgs.data.synthetic.scene_file import find_scene
from vlgs.data.synthetic.settings import SceneSettings
from vlgs.data.synthetic.world import World
from vlgs.fields.splat import SplatModel
from vlgs.geometry import camera_center
from vlgs.metrics.image import psnr
from vlgs.types import Camera, Scene

_NEARLY = 0.999
"""Of the way to a point on a surface a ray from elsewhere must come: rounding ends it a little before or behind."""


def capture_of(data: DictConfig) -> Capture:
    """The traced photographs of a procedural scene, from the cache where they are there.

    Args:
        data: Arguments of `vlgs.data.synthetic.load_scene`.
    """
    settings = SceneSettings(
        find_scene(data.scene), data.difficulty, data.width, data.height, data.train_views, data.test_views, data.seed
    )  # fmt: skip
    return open_capture(settings, None if data.cache is None else Path(data.cache))


def shown_pixels(capture: Capture) -> dict[str, Bool[Tensor, "h w"]]:
    """Held-out view -> whether its pixel's first surface is the first one in at least one training photograph as well."""
    found = {}
    for shot in capture.test:
        points = _surface(shot)
        seen = np.zeros(points.shape[1], bool)
        for other in capture.train:
            seen |= _shows(capture.world, other.camera, points)
        found[shot.name] = torch.from_numpy(seen.reshape(shot.photo.distance.shape))
    return found


@torch.no_grad()
def psnr_shown(
    model: SplatModel, scene: Scene, shown: dict[str, Bool[Tensor, "h w"]]
) -> list[float]:
    """PSNR of each held-out view over the pixels that `shown_pixels` names, dB; views without one are left out."""
    found = []
    for view in scene.test:
        color = model.render(view.camera, language=False).color
        assert color is not None
        value = psnr(color.clamp(0, 1), view.read_image() / 255, shown[view.name])
        found += [] if value is None else [value]
    return found


def _surface(shot: Shot) -> Float[np.ndarray, "3 n"]:
    """The point of every pixel's first surface, in world coordinates."""
    distance = shot.photo.distance
    y, x = (axis.ravel() + 0.5 for axis in np.indices(distance.shape).astype(np.float64))
    origin, direction = pixel_rays(shot.camera, x, y)
    return origin + direction * distance.ravel()


def _shows(
    world: World, camera: Camera, points: Float[np.ndarray, "3 n"]
) -> Bool[np.ndarray, " n"]:
    """Whether each point lies in a camera's picture, and a ray from it comes that far."""
    K, viewmat = camera.K.double().numpy(), camera.viewmat.double()
    center = camera_center(viewmat).numpy()[:, None]
    local = viewmat.numpy()[:3, :3] @ (points - center)
    before = local[2] > 0
    x, y, _ = K @ (local / np.where(before, local[2], 1.0))
    inside = np.flatnonzero(before & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))
    ray = points[:, inside] - center
    length = np.linalg.norm(ray, axis=0)
    first = world.first_hit(center, ray / length, np.zeros(inside.size)).t
    shown = np.zeros(points.shape[1], bool)
    shown[inside[first > _NEARLY * length]] = True
    return shown
