"""Which Gaussians a camera may see: a superset, at the price of a projection."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.ops.project import project
from vlgs.types import Camera, Gaussians, RasterConfig, Shape

SLACK = 1.0
"""Pixels that cover what rounding takes away."""


@torch.no_grad()
def may_see(gaussians: Gaussians, camera: Camera, config: RasterConfig) -> Bool[Tensor, " n"]:
    """Rows whose ellipse at `alpha_min`, for a weight of 1, may touch the image.

    All others have no pixel in any group, whatever their weights and values.
    """
    seen = _reaches(gaussians.means, Shape(gaussians.quats, gaussians.scales), camera, config)
    if gaussians.language_shape is not None:
        seen |= _reaches(gaussians.means, gaussians.language_shape, camera, config)
    return seen


def _reaches(
    means: Float[Tensor, "n 3"], shape: Shape, camera: Camera, config: RasterConfig
) -> Bool[Tensor, " n"]:
    splats = project(means, shape.quats, shape.scales, camera, config)
    reach = math.sqrt(2 * math.log(1 / config.alpha_min)) * (1 + 1e-5)
    inv_x, slope, inv_y = splats.ellipse.unbind(1)
    half_y = reach / inv_y
    half_x = torch.hypot(reach / inv_x, slope * half_y)
    x, y = splats.mean2d.unbind(1)
    inside = (x + half_x > -SLACK) & (x - half_x < camera.width + SLACK)
    inside &= (y + half_y > -SLACK) & (y - half_y < camera.height + SLACK)
    return inside & (splats.depth > 0)
