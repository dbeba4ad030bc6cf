"""Which row of a table codes choose, and how far their scores are from the right choice: the first term of GOI's loss."""

from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.heads.rows import for_error, in_blocks, linear_gradients

CHUNK = 2048
"""Pixels whose scores are turned into gradients at once: 2.5 MB of 300, which stay in cache. With fewer, threads wait for each other."""


def choose(
    codes: Float[Tensor, "p d"],
    weight: Float[Tensor, "k d"],
    bias: Float[Tensor, " k"],
    right: Int[Tensor, " p"],
    counts: float = 1.0,
) -> tuple[Float[Tensor, ""], Int[Tensor, " p"]]:
    """How far ``softmax(W c + b)`` is from the unit vector of the right row, and the row of the highest score.

    The error is squared, its mean over pixels and rows. Scores of a view would be tens of megabytes, and autograd would pass over them
    twenty times: each chunk is scored once, and its gradient is formed there and then.

    Args:
        codes: Of at least one pixel.
        weight: W.
        bias: b.
        right: Row of each pixel.
        counts: Factor of the error in what is differentiated. Another one comes to the same gradients but for rounding.

    Example:
        >>> codes, weight = torch.tensor([[0.0], [200.0]]), torch.tensor([[0.0], [1.0]])
        >>> choose(codes, weight, torch.zeros(2), torch.tensor([0, 1]))
        (tensor(0.1250), tensor([0, 1]))
    """
    numbers = len(codes) * len(weight)
    toward = codes.new_ones(()) * counts / numbers  # the gradient by a sum, as autograd forms it
    parts = [
        cast(tuple[Tensor, Tensor], _Choice.apply(*some, weight, bias, toward))
        for some in zip(codes.split(CHUNK), right.split(CHUNK), strict=True)
    ]
    errors, best = zip(*parts, strict=True)
    return torch.stack(errors).sum() / numbers, torch.cat(best)


class _Choice(torch.autograd.Function):
    """The sum of the errors of a chunk, and what it chooses. Gradients are those of plain torch on `linear_rows`, bit for bit."""

    @staticmethod
    def forward(
        ctx: Any, codes: Tensor, right: Tensor, weight: Tensor, bias: Tensor, toward: Tensor
    ) -> tuple[Tensor, Tensor]:
        blocks = in_blocks(codes)
        scores = torch.baddbmm(bias, blocks, weight.T.expand(len(blocks), -1, -1))
        flat = scores.flatten(0, 1)
        best = flat[: len(codes)].max(dim=-1).indices  # in half the time of argmax
        errors, made = _errors(flat[: len(codes)], right[:, None], 2 * toward)
        flat[: len(codes)], flat[len(codes) :] = made, 0
        d_blocks, *d_map = linear_gradients(scores, blocks, weight)
        ctx.save_for_backward(d_blocks.flatten(0, 1)[: len(codes)], *d_map, toward)
        ctx.mark_non_differentiable(best)
        return errors.sum(), best

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        *made, toward = ctx.saved_tensors
        d_codes, d_weight, d_bias = for_error(made, toward, grad_outputs[0])
        return d_codes, None, d_weight, d_bias, None


def _errors(
    scores: Float[Tensor, "c k"], right: Int[Tensor, "c 1"], twice: Float[Tensor, ""]
) -> tuple[Float[Tensor, " c"], Float[Tensor, "c k"]]:
    """``|s|^2 - 2 s_right + 1`` with s the softmax of scores, and the gradients by the scores.

    Args:
        scores: Of some pixels.
        right: Row of each.
        twice: Twice the gradient by an error.
    """
    logs = scores.log_softmax(dim=-1)
    odds = logs.exp()
    errors = odds.square().sum(dim=-1) - 2 * odds.gather(1, right)[:, 0] + 1
    d_odds = odds * twice
    d_odds.scatter_add_(1, right, -twice.expand(len(right), 1))
    # torch's own gradient of a softmax has other bits on more threads
    made = torch.ops.aten._log_softmax_backward_data(d_odds.mul_(odds), logs, -1, scores.dtype)
    return errors, made
