"""PSNR and SSIM of a rendered view against its photograph, both on [0, 1] and over the pixels the photograph covers."""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

NAME = "image"
VERSION = 1

_BLOCK = 64
"""Pixels that a product with the window makes at once. Few enough for sums of a product to be one chain, as those of a convolution are."""


def psnr(
    image: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    valid: Bool[Tensor, "h w"] | None = None,
) -> float | None:
    """Peak signal-to-noise ratio in dB for a peak of 1; infinite for equal images, None without a valid pixel.

    Example:
        >>> import torch
        >>> round(psnr(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.1)), 6)
        20.0
    """
    error = (image.double() - truth.double()).square()
    if valid is not None:
        error = error[valid]
    if not error.numel():
        return None
    mse = error.mean().item()
    return -10 * math.log10(mse) if mse > 0 else math.inf


def ssim(
    image: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    valid: Bool[Tensor, "h w"] | None = None,
    border: Literal["mirror", "zero"] = "mirror",
) -> float | None:
    """Structural similarity in [-1, 1], 11x11 Gaussian window of sigma 1.5; None without a valid pixel.

    Computed in float64, where E[x^2] - E[x]^2 of a flat image stays clean (tests/README.md, N15).

    Args:
        image: What was rendered.
        truth: The photograph.
        valid: Pixels that count.
        border: ``mirror``: windows see the image mirrored beyond its border, as in torchmetrics. ``zero``: they see black, as in
            3DGS; 0.598 -> 0.621 on a smoke run at 200 px across.

    Raises:
        ValueError: If a side is shorter than 6 pixels, too short to mirror the window.
    """
    if min(image.shape[:2]) < 6:
        raise ValueError(
            f"ssim: images must be at least 6x6 pixels, got {image.shape[0]}x{image.shape[1]}"
        )
    a, b = (x.double().permute(2, 0, 1)[None] for x in (image, truth))
    if border == "zero":
        values = _ssim_zero_padded(a, b)
    else:
        from kornia.metrics import ssim as ssim_map  # half a second to import

        values = ssim_map(a, b, window_size=11, max_val=1.0, eps=0.0)
    values = values[0].mean(dim=0)  # [h, w]
    if valid is not None:
        values = values[valid]
    return values.mean().clamp(-1, 1).item() if values.numel() else None


def _ssim_zero_padded(a: Float[Tensor, "1 c h w"], b: Float[Tensor, "1 c h w"]) -> Tensor:
    """SSIM of every pixel [1, c, h, w], windows zero beyond the border."""
    at = torch.arange(-5, 6, dtype=a.dtype)
    window = torch.exp(-at.square() / (2 * 1.5**2))
    window /= window.sum()
    stacked = torch.cat([a, b, a * a, b * b, a * b]).flatten(0, 1)
    mean = _windowed(_windowed(stacked, window).mT, window).mT.contiguous()
    ma, mb, aa, bb, ab = mean.chunk(5)
    c1, c2 = 0.01**2, 0.03**2
    similar = (2 * ma * mb + c1) * (2 * (ab - ma * mb) + c2)
    return (similar / ((ma**2 + mb**2 + c1) * (aa - ma**2 + bb - mb**2 + c2)))[None]


def _windowed(maps: Float[Tensor, "b h w"], window: Float[Tensor, " odd"]) -> Tensor:
    """Each row under a window, zero beyond its ends, as products with a band of window values: a quarter of a convolution's time."""
    width, reach = maps.shape[-1], len(window) - 1
    band = maps.new_zeros(_BLOCK + reach, _BLOCK)
    for column in range(_BLOCK):
        band[column : column + len(window), column] = window
    starts = range(
        0, width, _BLOCK
    )  # the last block is filled up: narrow products add in another order
    padded = pad(maps, (reach // 2, reach // 2 + len(starts) * _BLOCK - width))
    parts = [padded[..., at : at + _BLOCK + reach] @ band for at in starts]
    return torch.cat(parts, dim=-1)[..., :width]


NO_LPIPS = "LPIPS needs a pretrained AlexNet or VGG from torchvision (also in torchmetrics, lpips and piq), which is not a dependency"
"""The reason in every result why `lpips` is missing."""
