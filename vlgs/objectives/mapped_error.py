"""The mean absolute error of embeddings that a linear map makes of codes: of a view they would be a map of 512 numbers per pixel."""

from typing import Any, cast

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.heads.rows import for_error, in_blocks, linear_gradients
from vlgs.ops.mapped_error import mapped_error_


def mapped_l1(
    codes: Float[Tensor, "p d"],
    weight: Float[Tensor, "e d"],
    bias: Float[Tensor, " e"],
    wanted: Float[Tensor, "m e"],
    which: Int64[Tensor, " p"],
    counts: float = 1.0,
) -> Float[Tensor, ""]:
    """Mean of ``|W c + b - t|`` over pixels and numbers.

    Gradients are those of plain torch on `linear_rows`, bit for bit. They are formed along with the error, in the place of the
    embeddings: besides, nothing as large is made, kept or read again.

    Args:
        codes: c, of at least one pixel.
        weight: W.
        bias: b.
        wanted: Every t that there is.
        which: The row of `wanted` that is t, for each pixel.
        counts: Factor of the error in what is differentiated. Another one comes to the same gradients but for rounding.

    Example:
        >>> target = torch.tensor([[1.0, 0.0], [0.0, 4.0]])
        >>> mapped_l1(torch.ones(2, 1), torch.ones(2, 1), torch.zeros(2), target, torch.arange(2))
        tensor(1.2500)
    """
    toward = codes.new_ones(()) * counts
    return cast(Tensor, _MappedL1.apply(codes, weight, bias, wanted, which, toward))


class _MappedL1(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        codes: Tensor,
        weight: Tensor,
        bias: Tensor,
        wanted: Tensor,
        which: Tensor,
        toward: Tensor,
    ) -> Tensor:
        blocks = in_blocks(codes)
        made = torch.bmm(blocks, weight.T.expand(len(blocks), -1, -1))
        flat, numbers = made.flatten(0, 1), len(codes) * len(weight)
        flat[len(codes) :] = 0
        total = mapped_error_(flat, bias, wanted, which, (toward / numbers).item())
        d_blocks, *d_map = linear_gradients(made, blocks, weight)
        ctx.save_for_backward(d_blocks.flatten(0, 1)[: len(codes)], *d_map, toward)
        return codes.new_tensor(total / numbers)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        *made, toward = ctx.saved_tensors
        return *for_error(made, toward, grad_outputs[0]), None, None, None
