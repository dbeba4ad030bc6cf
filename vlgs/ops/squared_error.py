"""The mean squared error of two images over the pixels that count."""

from typing import Any, Literal, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels

Pixels = Literal["valid", "all"]
"""Whose number an average is divided by: pixels that have a target, or all of them (as LangSplat does)."""


def squared_error(
    render: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None,
    pixels: Pixels,
) -> Float[Tensor, ""]:
    """`vlgs.losses.masked_mse` on checked input; tests/losses/test_losses_pixels.py has the definition in plain torch."""
    return KERNELS.of(render)(render, target, valid, pixels)


class _SquaredError(torch.autograd.Function):
    """csrc/squared_error.cpp."""

    @staticmethod
    def forward(ctx: Any, render: Tensor, target: Tensor, valid: Tensor | None, pixels: Pixels):
        render, target = render.contiguous(), target.contiguous()
        valid = None if valid is None else valid.contiguous()
        total, count = _csrc.squared_error(*arrays(render, target, valid), torch.get_num_threads())
        ctx.save_for_backward(render, target, valid)
        ctx.numbers = max(render.numel() if pixels == "all" else count * render.shape[-1], 1)
        return render.new_tensor(total / ctx.numbers)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_loss: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        render, target, valid = ctx.saved_tensors
        d_render = torch.empty_like(render)
        scale = 2 * d_loss.item() / ctx.numbers
        given, threads = arrays(render, target, valid), torch.get_num_threads()
        _csrc.squared_error_backward(*given, scale, *arrays(d_render), threads)
        return d_render, -d_render if ctx.needs_input_grad[1] else None, None, None


def _on_cpu(render: Tensor, target: Tensor, valid: Tensor | None, pixels: Pixels) -> Tensor:
    return cast(Tensor, _SquaredError.apply(render, target, valid, pixels))


KERNELS = Kernels("squared_error", cpu=_on_cpu)
