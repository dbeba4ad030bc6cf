"""The scenes on which rasterizers are timed, defined so that figures from elsewhere compare.

A pinhole camera at the origin with focal length 0.9 x width; depth uniform in [2, 6]; screen position uniform over 110 % of
the frame; log-normal anisotropic scales; opacity and indicator independent sigmoid(-1 + 1.2 normal). Scales are chosen so
that about `covering` Gaussians reach every pixel above 1/255, whatever their number: 6.5 M pairs per weight at 320 x 240
and 26 M at 640 x 480. Everything comes from one PCG64 generator, in the order of the lines below.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.types import Camera, ChannelGroup


class Workload(NamedTuple):
    """Gaussians, a camera and the gradients of a loss by the two images."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    groups: tuple[ChannelGroup, ChannelGroup]
    """Colour with opacity, language with its indicator."""
    camera: Camera
    upstream: tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w d"]]

    def leaves(self) -> list[Tensor]:
        """Every tensor that gets a gradient."""
        color, language = self.groups
        weights = [color.weight, language.weight]
        return [self.means, self.quats, self.scales, color.values, language.values, *weights]


def make_workload(
    n: int, width: int, height: int, channels: int = 3, seed: int = 0, covering: float = 70.0
) -> Workload:
    """One scene in float32, its leaves requiring gradients.

    Args:
        n: Gaussians.
        width: Pixels.
        height: Pixels.
        channels: Of language; colour has 3.
        seed: Of the generator.
        covering: Gaussians per pixel that the scales aim at.
    """
    rng = np.random.default_rng(seed)
    focal = 0.9 * width
    depth = rng.uniform(2, 6, n)
    x = rng.uniform(-0.05 * width, 1.05 * width, n)
    y = rng.uniform(-0.05 * height, 1.05 * height, n)
    opacity, indicator = (1 / (1 + np.exp(1 - 1.2 * rng.standard_normal(n))) for _ in range(2))
    # An ellipse at 1/255 covers 2 pi sigma^2 ln(255 o) pixels; 0.3 pixel^2 of it is the rasterizer's blur.
    octaves = np.log(np.maximum(255 * opacity, 1)).mean()
    variance = covering * 1.1**2 * width * height / (n * 2 * math.pi * octaves) - 0.3
    sigma = math.sqrt(max(variance, 0.05)) * depth / focal
    scales = sigma[:, None] * np.exp(0.35 * rng.standard_normal((n, 3)))
    quats = rng.standard_normal((n, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    means = np.stack([(x - width / 2) / focal * depth, (y - height / 2) / focal * depth, depth], 1)
    colors = rng.uniform(0, 1, (n, 3))
    codes = rng.standard_normal((n, channels)) / math.sqrt(channels)
    d_color, d_language = (
        rng.standard_normal((height, width, c)) / (width * height) for c in (3, channels)
    )

    def leaf(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array.astype(np.float32)).requires_grad_()

    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Workload(
        leaf(means), leaf(quats), leaf(scales),
        (ChannelGroup(leaf(colors), leaf(opacity)), ChannelGroup(leaf(codes), leaf(indicator))),
        Camera(torch.eye(4), K, width, height),
        (torch.from_numpy(d_color).float(), torch.from_numpy(d_language).float()),
    )  # fmt: skip
