"""The loss of 3DGS: absolute error and structural dissimilarity of two images, in one pass."""

from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels
from vlgs.ops.ssim import FLOORS, taps


def l1_dssim(
    render: Float[Tensor, "h w c"],
    image: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None,
    l1_share: float,
) -> Float[Tensor, ""]:
    """`vlgs.losses.l1_dssim` on checked input; tests/losses/test_losses_ssim_gradient.py has the definition in plain torch."""
    return KERNELS.of(render)(render, image, valid, l1_share)


class _L1Dssim(torch.autograd.Function):
    """csrc/ssim.cpp."""

    @staticmethod
    def forward(ctx: Any, render: Tensor, image: Tensor, valid: Tensor | None, l1_share: float):
        render, image = render.contiguous(), image.contiguous()
        valid = None if valid is None else valid.contiguous()
        distance, dissimilarity, count = _csrc.ssim_sums(
            *arrays(render, image, valid, taps(render.dtype)), FLOORS, torch.get_num_threads()
        )
        ctx.save_for_backward(render, image, valid)
        ctx.l1_share, ctx.numbers = l1_share, max(count * render.shape[-1], 1)
        total = l1_share * distance + (1 - l1_share) * dissimilarity
        return render.new_tensor(total / ctx.numbers)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_loss: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        render, image, valid = ctx.saved_tensors
        d_render = torch.empty_like(render)
        d_image = torch.empty_like(image) if ctx.needs_input_grad[1] else None
        scale = d_loss.item() / ctx.numbers
        _csrc.ssim_sums_backward(
            *arrays(render, image, valid, taps(render.dtype)), FLOORS,
            ctx.l1_share * scale, (1 - ctx.l1_share) * scale, *arrays(d_render, d_image), torch.get_num_threads(),
        )  # fmt: skip
        return d_render, d_image, None, None


def _on_cpu(render: Tensor, image: Tensor, valid: Tensor | None, l1_share: float) -> Tensor:
    return cast(Tensor, _L1Dssim.apply(render, image, valid, l1_share))


KERNELS = Kernels("l1_dssim", cpu=_on_cpu)
