"""The blending weights of single pixels: ``w_ip = alpha_i T_i`` of every Gaussian i at every pixel p that it reaches.

The kernels sum over pixels or over Gaussians as they go. What looks at the weights of one pixel together, or sums a function of
each weight, needs them one by one. They are formed here in float64, a few rows of the image at a time, so that memory does not grow with it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.ops.project import Splats
from vlgs.types import Camera, RasterConfig

PIXELS = 8192
"""Pixels at a time; some hundred Gaussians at each of them take 50 MB."""
SLACK = 1e-6
"""Pixels by which spans are longer than computed: what falls below `RasterConfig.alpha_min` is left out by its own weight."""


@dataclass(frozen=True)
class PixelWeights:
    """Weights of some pixels: those of one pixel stand together, front to back."""

    pixel: Int[Tensor, " z"]
    """Row by row of the whole image, never falling."""
    gaussian: Int[Tensor, " z"]
    weight: Float[Tensor, " z"]
    """Above 0; float64."""


@torch.no_grad()
def pixel_weights(
    splats: Splats, weight: Float[Tensor, " n"], camera: Camera, config: RasterConfig
) -> Iterator[PixelWeights]:
    """All weights of a view; `vlgs.ops.rasterize_reference` defines them.

    Args:
        splats: `vlgs.ops.project.project`.
        weight: In [0, 1], as in `ChannelGroup`.
        camera: That they were projected to.
        config: Constants of the rasterizer.
    """
    order = splats.depth.argsort(stable=True)
    order = order[(splats.depth > 0)[order] & (weight >= config.alpha_min)[order]]
    (x, y), own = splats.mean2d[order].double().T, weight[order].double()
    inverse_x, slope, inverse_y = splats.ellipse[order].double().T
    reach = (2 * (own / config.alpha_min).log()).sqrt()
    rows = _Ellipses(order, x, y, inverse_x, slope, inverse_y, own, reach)
    step = max(1, PIXELS // camera.width)
    for top in range(0, camera.height, step):
        yield _blended(rows, top, min(top + step, camera.height), camera.width, config)


@dataclass(frozen=True)
class _Ellipses:
    """What reaches the image, front to back; given y, x is normal about ``x + slope (y - mean)``."""

    gaussian: Int[Tensor, " m"]
    x: Float[Tensor, " m"]
    y: Float[Tensor, " m"]
    inverse_x: Float[Tensor, " m"]
    """1 / deviation of x given y."""
    slope: Float[Tensor, " m"]
    inverse_y: Float[Tensor, " m"]
    weight: Float[Tensor, " m"]
    reach: Float[Tensor, " m"]
    """Deviations at which the weight has fallen to `RasterConfig.alpha_min`."""


def _blended(
    rows: _Ellipses, top: int, bottom: int, width: int, config: RasterConfig
) -> PixelWeights:
    """The weights of the rows of pixels from `top` up to `bottom`."""
    half = rows.reach / rows.inverse_y
    index, y = _spread(*_between(rows.y - half, rows.y + half, top, bottom))
    dy = y + 0.5 - rows.y[index]
    v = rows.inverse_y[index] * dy
    half = (rows.reach[index].square() - v.square()).clamp_min(0).sqrt() / rows.inverse_x[index]
    middle = rows.x[index] + rows.slope[index] * dy
    line, x = _spread(*_between(middle - half, middle + half, 0, width))
    u = rows.inverse_x[index[line]] * (x + 0.5 - middle[line])
    alpha = rows.weight[index[line]] * torch.exp(-0.5 * (u.square() + v[line].square()))
    pixel = y[line] * width + x

    reaches = alpha >= config.alpha_min
    pixel, place = pixel[reaches].sort(stable=True)  # front to back, as the rows are
    alpha = alpha[reaches][place].clamp(max=config.alpha_max)
    gaussian = rows.gaussian[index[line]][reaches][place]
    after = torch.log1p(-alpha).cumsum(0)
    before = after - torch.log1p(-alpha)
    first = torch.searchsorted(pixel, pixel)  # of the same pixel
    transmittance = (before - before[first]).exp()
    left = transmittance if config.stop == "after" else transmittance * (1 - alpha)
    live = left > config.transmittance_min
    return PixelWeights(pixel[live], gaussian[live], (alpha * transmittance)[live])


def _between(
    low: Float[Tensor, " m"], high: Float[Tensor, " m"], first: int, end: int
) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """First pixel whose centre lies between the bounds, and how many do, of those from `first` up to `end`."""
    start = (low - 0.5 - SLACK).ceil().clamp(first, end)
    stop = (high - 0.5 + SLACK).floor().clamp(first - 1, end - 1)
    return start.long(), (stop - start + 1).clamp_min(0).long()


def _spread(
    start: Int[Tensor, " m"], count: Int[Tensor, " m"]
) -> tuple[Int[Tensor, " z"], Int[Tensor, " z"]]:
    """``start, start + 1, ...``, `count` of each row, and the rows that they belong to."""
    row = torch.repeat_interleave(torch.arange(len(count)), count)
    within = torch.arange(len(row)) - (count.cumsum(0) - count)[row]
    return row, start[row] + within
