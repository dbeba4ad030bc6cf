"""Huber's loss of a wide map over the pixels that count, in one pass."""

from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels


def huber_sum(
    image: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"],
    delta: float,
) -> Float[Tensor, ""]:
    """Sum of ``x^2 / 2`` up to delta and ``delta (|x| - delta / 2)`` beyond; x is the difference at pixels that count.

    Gradients by the image are those of `torch.nn.functional.huber_loss`, bit for bit; the target gets none.

    Example:
        >>> huber_sum(torch.tensor([[[3.0, 0.5]]]), torch.zeros(1, 1, 2), torch.tensor([[True]]), 1.0)
        tensor(2.6250)

    Raises:
        ValueError: If shapes do not fit.
    """
    if target.shape != image.shape or valid.shape != image.shape[:2]:
        raise ValueError(
            f"huber: target and valid must be of the image's {list(image.shape)}, got {list(target.shape)} and {list(valid.shape)}"
        )
    return KERNELS.of(image)(image, target, valid, delta)


class _Huber(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, valid: Tensor, delta: float) -> Tensor:
        clamped = image.new_empty(image.shape)
        if image.stride(2) != 1:  # a part of a wider map is read where it lies
            image = image.contiguous()
        given = arrays(image.detach(), target.contiguous(), valid.contiguous())
        total = _csrc.huber(*given, delta, *arrays(clamped), torch.get_num_threads())
        ctx.save_for_backward(clamped)
        return image.new_tensor(total)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        (clamped,) = ctx.saved_tensors
        return clamped * grad_outputs[0], None, None, None


def _on_cpu(image: Tensor, target: Tensor, valid: Tensor, delta: float) -> Tensor:
    return cast(Tensor, _Huber.apply(image, target, valid, delta))


KERNELS = Kernels("huber", cpu=_on_cpu)
