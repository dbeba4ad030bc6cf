"""Sparse points as structure from motion would find them: on textured surfaces, hardly any on glass and steel."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vlgs.data.synthetic.photographs import TracedImage, pixel_rays
from vlgs.data.synthetic.world import World
from vlgs.types import Camera

_KEPT = {"matte": 1.0, "light": 0.0, "glass": 0.12, "mirror": 0.12}
"""Share of the candidates that survive, by material: what moves with the viewer is not matched."""
_ERROR = 0.002  # standard deviation of a position, relative to its distance
_OUTLIERS = 0.01  # share of points that lie anywhere along their ray


def view_points(
    world: World, camera: Camera, photo: TracedImage, count: int, rng: np.random.Generator
) -> tuple[Float[Tensor, "p 3"], UInt8[Tensor, "p 3"]]:
    """At most `count` points seen by one view, in world units, with the colours of their pixels."""
    pixels = rng.integers(0, photo.part.size, count)
    keep = np.array([_KEPT[part.material.kind] for part in world.parts])
    kept = rng.random(count) < keep[photo.part.ravel()[pixels]]
    error = 1 + _ERROR * rng.normal(size=(3, count))
    outlier = rng.random(count) < _OUTLIERS
    stray = rng.uniform(0.4, 1.6, count)

    y, x = np.divmod(pixels, camera.width)
    origin, direction = pixel_rays(camera, x + 0.5, y + 0.5)
    along = photo.distance.ravel()[pixels] * np.where(outlier, stray, 1.0)
    points = origin + direction * along + along * (error - 1)
    colors = photo.image.reshape(-1, 3)[pixels]
    return torch.from_numpy(points.T[kept]).float(), torch.from_numpy(colors[kept])
