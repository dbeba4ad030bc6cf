"""Errors of images and maps, which objectives minimise: those of Eqs. 8, 11 and 12, and alternatives to them (conf/README.md, D.8).

Images and maps are ``[h, w, c]``. A mask says which pixels count. The target's values at all other pixels are never read; they
may even be NaN.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import l1_loss

from vlgs.ops import l1_dssim as ops_l1_dssim
from vlgs.ops import ssim as ops_ssim
from vlgs.ops.absolute_error import absolute_error
from vlgs.ops.squared_error import Pixels, squared_error

L1_SHARE = 0.8
RENDER_FLOOR = 1e-2
"""Shorter renders are treated as this long in `masked_cosine`: codes start at zero, where a cosine has no slope."""
TARGET_FLOOR = 1e-6


def masked_mse(
    render: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None = None,
    pixels: Pixels = "valid",
) -> Float[Tensor, ""]:
    """Mean squared error over the pixels that count, and over channels; 0 without such a pixel (Eq. 8).

    Raises:
        ValueError: If the shapes differ.

    Example:
        >>> render, valid = torch.full((1, 2, 1), 3.0), torch.tensor([[True, False]])
        >>> masked_mse(render, torch.ones(1, 2, 1), valid), masked_mse(render, torch.ones(1, 2, 1), valid, "all")
        (tensor(4.), tensor(2.))
    """
    _require_shapes("masked_mse", render, target, valid)
    return squared_error(render, target, valid, pixels)


def masked_l1(
    render: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None = None,
    pixels: Pixels = "valid",
) -> Float[Tensor, ""]:
    """Mean absolute error; otherwise as `masked_mse`."""
    _require_shapes("masked_l1", render, target, valid)
    if valid is None:
        return absolute_error(render, target)
    total = l1_loss(render, _filled(target, valid, render), reduction="sum")
    return total / _count(render, valid, pixels)


def masked_cosine(
    render: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None = None,
    pixels: Pixels = "valid",
) -> Float[Tensor, ""]:
    """Mean of ``1 - cos(render, target)`` over pixels; otherwise as `masked_mse`.

    Each side is divided by its own length, no less than `RENDER_FLOOR` or `TARGET_FLOOR`: a zero vector has cosine 0
    with everything and a finite gradient.
    """
    _require_shapes("masked_cosine", render, target, valid)
    if valid is not None:
        target = target.masked_fill(~valid[..., None], 0)
    direction = render / render.norm(dim=-1, keepdim=True).clamp_min(RENDER_FLOOR)
    wanted = target / target.norm(dim=-1, keepdim=True).clamp_min(TARGET_FLOOR)
    error = 1 - (direction * wanted).sum(dim=-1, keepdim=True)
    if valid is None:
        return error.mean()
    return error.masked_fill(~valid[..., None], 0).sum() / _count(error, valid, pixels)


def ssim(a: Float[Tensor, "h w c"], b: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Structural similarity in [-1, 1] of two images in [0, 1], as 3DGS computes it.

    Gaussian window of 11 x 11 pixels, sigma 1.5, zeros beyond the edge, mean over pixels and channels. Differentiable;
    images smaller than the window are fine.

    Raises:
        ValueError: If the shapes differ or an image has no pixels.

    Example:
        >>> image = torch.rand(20, 30, 3)
        >>> ssim(image, image)
        tensor(1.)
    """
    return ssim_map(a, b).mean()


def ssim_map(a: Float[Tensor, "h w c"], b: Float[Tensor, "h w c"]) -> Float[Tensor, "h w c"]:
    """The terms of `ssim`, one per pixel and channel, from the moments of ``p = a + b`` and ``q = a - b``.

    ``4 cov(a, b) = var p - var q`` and ``2 (var a + var b) = var p + var q``, and the same for the means. With both
    variances clamped at 0, against the cancellation in E[x^2] - E[x]^2, each factor is within [-1, 1] whatever the
    rounding, equal images give exactly 1, and four moments are filtered instead of five.
    """
    _require_shapes("ssim", a, b)
    _require_pixels("ssim", a)
    return ops_ssim.ssim_map(a, b)


def l1_dssim(
    render: Float[Tensor, "h w c"],
    image: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None = None,
) -> Float[Tensor, ""]:
    """``0.8 L1 + 0.2 (1 - SSIM)``, the loss of 3DGS.

    With a mask, both means are over its pixels, and windows that reach beyond it see no difference there.

    Raises:
        ValueError: If the shapes differ or the images have no pixels.
    """
    _require_shapes("l1_dssim", render, image, valid)
    _require_pixels("l1_dssim", render)
    return ops_l1_dssim.l1_dssim(render, image, valid, L1_SHARE)


@torch.no_grad()
def view_similarity(image1: Float[Tensor, "h w c"], image2: Float[Tensor, "h w c"]) -> float:
    """``max(0, SSIM(I1, I2))``, the weight of a pair in Eq. 11; a constant of the pair, so worth a cache.

    SSIM goes down to -1, and a negative weight would reward a wrong render (conf/README.md, D.12). The bits do not depend on the number
    of threads: the mean over a map does, so it is taken on one.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return max(0.0, ssim(image1, image2).item())
    finally:
        torch.set_num_threads(threads)


def _filled(target: Tensor, valid: Tensor, render: Tensor) -> Tensor:
    """The target, or where it does not count the render itself, which leaves neither an error nor a gradient."""
    return torch.where(valid[..., None], target, render.detach())


def _count(error: Tensor, valid: Tensor, pixels: Pixels) -> Tensor | int:
    """How many numbers a mean is over; 1 instead of 0."""
    if pixels == "all":
        return error.numel()
    return valid.sum().clamp_min(1) * error.shape[-1]


def _require_pixels(who: str, image: Tensor) -> None:
    if image.numel() == 0:
        raise ValueError(f"{who}: images must have pixels, got shape {tuple(image.shape)}")


def _require_shapes(who: str, render: Tensor, target: Tensor, valid: Tensor | None = None) -> None:
    if render.shape != target.shape:
        raise ValueError(f"{who}: target must be {tuple(render.shape)}, got {tuple(target.shape)}")
    if valid is not None and valid.shape != render.shape[:2]:
        raise ValueError(
            f"{who}: valid must be {tuple(render.shape[:2])}, got {tuple(valid.shape)}"
        )
