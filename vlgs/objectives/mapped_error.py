"""The mean absolute error of embeddings that a linear map makes of codes: of a view they would be a map of 512 numbers per pixel."""

from collections.abc import Callable
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.heads.rows import for_error, in_blocks, linear_gradients

_CHUNK = 1024
"""Pixels whose embeddings are turned into gradients at once: 2 MB of 512, which stay in cache. With fewer, threads wait for each other."""


def mapped_l1(
    codes: Float[Tensor, "p d"],
    weight: Float[Tensor, "e d"],
    bias: Float[Tensor, " e"],
    wanted: Callable[[slice], Float[Tensor, "q e"]],
    counts: float = 1.0,
) -> Float[Tensor, ""]:
    """Mean of ``|W c + b - t|`` over pixels and numbers.

    Gradients are those of plain torch on `linear_rows`, bit for bit. They are formed along with the error, in the place of the
    embeddings: besides, nothing as large is made, kept or read again.

    Args:
        codes: c, of at least one pixel.
        weight: W.
        bias: b.
        wanted: t of some pixels, which is asked for in turn.
        counts: Factor of the error in what is differentiated. Another one comes to the same gradients but for rounding.

    Example:
        >>> target = torch.tensor([[1.0, 0.0], [0.0, 4.0]])
        >>> mapped_l1(torch.ones(2, 1), torch.ones(2, 1), torch.zeros(2), target.__getitem__)
        tensor(1.2500)
    """
    toward = codes.new_ones(()) * counts
    return cast(Tensor, _MappedL1.apply(codes, weight, bias, wanted, toward))


class _MappedL1(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        codes: Tensor,
        weight: Tensor,
        bias: Tensor,
        wanted: Callable[[slice], Tensor],
        toward: Tensor,
    ) -> Tensor:
        blocks = in_blocks(codes)
        made = torch.baddbmm(bias, blocks, weight.T.expand(len(blocks), -1, -1))
        flat = made.flatten(0, 1)
        flat[len(codes) :] = 0
        numbers = len(codes) * len(weight)
        totals = []
        for at in range(0, len(codes), _CHUNK):
            some = slice(at, min(at + _CHUNK, len(codes)))
            errors = flat[some].sub_(wanted(some))
            totals.append(errors.abs().sum())
            errors.sign_().mul_(toward / numbers)
        d_blocks, *d_map = linear_gradients(made, blocks, weight)
        ctx.save_for_backward(d_blocks.flatten(0, 1)[: len(codes)], *d_map, toward)
        return torch.stack(totals).sum() / numbers

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        *made, toward = ctx.saved_tensors
        return *for_error(made, toward, grad_outputs[0]), None, None
