"""PSNR and SSIM of a rendered view against its photograph, both on [0, 1] and over the pixels the photograph covers (B.5)."""

import math

from jaxtyping import Bool, Float
from torch import Tensor

NAME = "image"
VERSION = 1


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
) -> float | None:
    """Structural similarity in [-1, 1]: 11x11 Gaussian window of sigma 1.5, borders mirrored; None without a valid pixel.

    Computed in float64, where E[x^2] - E[x]^2 of a flat image stays clean (pitfalls.md N15). 3DGS pads with zeros instead, which
    moves the third to fourth decimal.

    Raises:
        ValueError: If a side is shorter than 6 pixels, too short to mirror the window.
    """
    from kornia.metrics import ssim as ssim_map  # half a second to import

    if min(image.shape[:2]) < 6:
        raise ValueError(
            f"ssim: images must be at least 6x6 pixels, got {image.shape[0]}x{image.shape[1]}"
        )
    a, b = (x.double().permute(2, 0, 1)[None] for x in (image, truth))
    values = ssim_map(a, b, window_size=11, max_val=1.0, eps=0.0)[0].mean(dim=0)  # [h, w]
    if valid is not None:
        values = values[valid]
    return values.mean().clamp(-1, 1).item() if values.numel() else None
