"""Numbers to colours, and masks over photographs. Images are uint8 RGB tensors."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from vlgs.types import IGNORE_ID

IGNORED = (232, 232, 232)
"""Light grey: pixels without a class."""


def to_uint8(image: Float[Tensor, "h w 3"]) -> UInt8[Tensor, "h w 3"]:
    """Colours in [0, 1], rounded; what lies outside is clamped."""
    return (image.clamp(0, 1) * 255).round().to(torch.uint8)


def heat(values: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w 3"]:
    """Turbo colour map of values in [0, 1], dark blue to dark red."""
    return _lookup("turbo", values)


def diverging(values: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w 3"]:
    """Blue at -1, near white at 0, red at 1."""
    return _lookup("RdBu_r", (values + 1) / 2)


def label_colors(count: int) -> UInt8[Tensor, "{count} 3"]:
    """Distinct colours of class ids 0, 1, ...: strong ones first, their pale partners after, then hues a golden angle apart."""
    from matplotlib import colormaps
    from matplotlib.colors import hsv_to_rgb

    pairs = torch.from_numpy(colormaps["tab20"](range(20))[:, :3].copy())  # (strong, pale) x 10
    named = torch.cat([pairs[0::2], pairs[1::2]])
    more = [
        hsv_to_rgb(((i * 0.618034) % 1, 0.45 + 0.4 * (i % 2), 0.6 + 0.3 * (i % 3) / 2))
        for i in range(max(count - len(named), 0))
    ]
    colors = torch.cat([named, torch.from_numpy(np.array(more).reshape(-1, 3))])[:count]
    return (colors * 255).round().to(torch.uint8)


def paint_labels(
    ids: Int[Tensor, "h w"] | UInt8[Tensor, "h w"], count: int
) -> UInt8[Tensor, "h w 3"]:
    """A class map in the colours of `label_colors`; pixels of `IGNORE_ID` are light grey."""
    colors = torch.cat([label_colors(count), torch.tensor([IGNORED], dtype=torch.uint8)])
    return colors[ids.long().masked_fill(ids == IGNORE_ID, count)]


def heat_over(
    photograph: UInt8[Tensor, "h w 3"], values: Float[Tensor, "h w"], opacity: float = 0.65
) -> UInt8[Tensor, "h w 3"]:
    """Turbo over the grey photograph, so that colours are the map's and shapes are the photograph's."""
    mixed = (1 - opacity) * _grey(photograph) + opacity * heat(values).float()
    return mixed.round().to(torch.uint8)


def mask_over(
    photograph: UInt8[Tensor, "h w 3"],
    prediction: Bool[Tensor, "h w"],
    truth: Bool[Tensor, "h w"],
) -> UInt8[Tensor, "h w 3"]:
    """The photograph dimmed outside the predicted mask, the outline of the truth in yellow."""
    picture = torch.where(prediction[..., None], photograph.float(), 0.3 * _grey(photograph))
    picture = picture.round().to(torch.uint8)
    picture[outline(truth)] = torch.tensor((255, 221, 0), dtype=torch.uint8)
    return picture


def outline(mask: Bool[Tensor, "h w"], width: int | None = None) -> Bool[Tensor, "h w"]:
    """Pixels of a mask within `width` of its border; by default 1 for each started 400 pixels of image width."""
    width = -(-mask.shape[1] // 400) if width is None else width
    outside = (
        torch.nn.functional.max_pool2d(
            (~mask).float()[None], 2 * width + 1, stride=1, padding=width
        )[0]
        > 0
    )
    return mask & outside


def stretch(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Minimum to 0 and maximum to 1; a constant map to 0."""
    shifted = values - values.min()
    return shifted / shifted.max().clamp_min(1e-9)


def _grey(photograph: UInt8[Tensor, "h w 3"]) -> Float[Tensor, "h w 1"]:
    return (photograph.float() @ torch.tensor([0.299, 0.587, 0.114]))[..., None]


def _lookup(name: str, values: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w 3"]:
    return _table(name)[(values.clamp(0, 1) * 255).round().long()]


@cache
def _table(name: str) -> Shaped[Tensor, "256 3"]:
    from matplotlib import colormaps  # 0.2 s that a run without pictures need not wait for

    rgba = colormaps[name](torch.linspace(0, 1, 256).numpy(), bytes=True)
    return torch.from_numpy(rgba[:, :3].copy())
