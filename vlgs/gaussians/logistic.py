"""The logistic function of weights, with bits that do not depend on threads and a slope that does not vanish early; and its inverse."""

from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def logit(probability: float) -> float:
    """Inverse of the logistic function for a value strictly between 0 and 1."""
    return torch.tensor(probability, dtype=torch.float64).logit().item()


class _Logistic(torch.autograd.Function):
    """1 / (1 + exp(-x)), whose bits do not depend on the number of threads: those of `torch.sigmoid` do (torch 2.13).

    Its slope is not y (1 - y), which is 0 in float32 from x = 17 on and would hold a Gaussian at 1 for ever.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.neg().exp_().add_(1).reciprocal_()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_y: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (x,) = ctx.saved_tensors
        falloff = x.abs().neg_().exp_()  # the slope is even in x
        return d_y * falloff / (1 + falloff).square_()


def logistic(x: Tensor) -> Tensor:
    """Weights in [0, 1] of logits."""
    return cast(Tensor, _Logistic.apply(x))
