"""Structural similarity of two images, pixel by pixel."""

from functools import cache
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.device import Kernels

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
FLOORS = (2 * C1, 2 * C2)
"""Of luminance and structure, for the moments of sum and difference, which are twice as large."""


def ssim_map(a: Float[Tensor, "h w c"], b: Float[Tensor, "h w c"]) -> Float[Tensor, "h w c"]:
    """`vlgs.losses.ssim_map` on checked input; tests/losses/test_losses_ssim_gradient.py has the definition in plain torch."""
    return KERNELS.of(a)(a, b)


@cache
def taps(dtype: torch.dtype) -> Float[Tensor, " taps"]:
    """The window along one side, on the CPU."""
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    return (weights / weights.sum()).to(dtype)


class _Ssim(torch.autograd.Function):
    """csrc/ssim.cpp."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor):
        a, b = a.contiguous(), b.contiguous()
        ctx.save_for_backward(a, b)
        out = a.new_empty(a.shape[2], *a.shape[:2])
        _csrc.ssim_map(a, b, taps(a.dtype), FLOORS, out, torch.get_num_threads())
        return out.permute(1, 2, 0)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_out: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        a, b = ctx.saved_tensors
        d_a, d_b = torch.empty_like(a), torch.empty_like(b) if ctx.needs_input_grad[1] else None
        _csrc.ssim_map_backward(
            a, b, taps(a.dtype), FLOORS, d_out.contiguous(), d_a, d_b, torch.get_num_threads()
        )
        return d_a, d_b


def _on_cpu(a: Tensor, b: Tensor) -> Tensor:
    return cast(Tensor, _Ssim.apply(a, b))


KERNELS = Kernels("ssim", cpu=_on_cpu)
