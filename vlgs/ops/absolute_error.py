"""The mean absolute error of two maps that may be wide: of what it needs for the way back, a byte per number is kept."""

from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def absolute_error(
    render: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]
) -> Float[Tensor, ""]:
    """Value and gradients are those of `torch.nn.functional.l1_loss`, bit for bit, where they are finite."""
    return cast(Tensor, _AbsoluteError.apply(render, target))


class _AbsoluteError(torch.autograd.Function):
    """PyTorch keeps the differences until their gradient is asked for, and makes two maps more then."""

    @staticmethod
    def forward(ctx: Any, render: Tensor, target: Tensor) -> Tensor:
        difference = render - target
        ctx.save_for_backward(difference.sign().to(torch.int8))
        return difference.abs_().mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_loss: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        (sign,) = ctx.saved_tensors
        d_render = sign.to(d_loss.dtype).mul_(d_loss / max(sign.numel(), 1))
        return d_render, -d_render if ctx.needs_input_grad[1] else None
