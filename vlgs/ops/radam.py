"""A step of RAdam in few passes (Liu et al., ICLR 2020)."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels

_PART = 1 << 18
"""Numbers of a part, a megabyte: large enough for threads, small enough to stay in cache with its gradients and moments."""


class Moments(NamedTuple):
    """Moving averages of a gradient."""

    mean: Float[Tensor, " n"]
    square: Float[Tensor, " n"]


@dataclass(frozen=True)
class Rates:
    """What is the same for all numbers in a step."""

    rate: float
    beta1: float
    beta2: float
    eps: float
    decay: float
    """Of the weights, added to the gradient."""
    step: float
    """Counts from 1."""


def radam_step(
    weight: Float[Tensor, " n"], gradient: Float[Tensor, " n"], moments: Moments, rates: Rates
) -> None:
    """Move weights and moments, bit for bit as `torch.optim.RAdam`, which passes over them a dozen times."""
    KERNELS.of(weight)(weight, gradient, moments, rates)


def _on_cpu(weight: Tensor, gradient: Tensor, moments: Moments, rates: Rates) -> None:
    kept1, kept2 = rates.beta1**rates.step, rates.beta2**rates.step
    # How many squares the average is worth: in an endless run, and after so many steps.
    endless = 2 / (1 - rates.beta2) - 1
    length = endless - 2 * rates.step * kept2 / (1 - kept2)
    adaptive, rectified = length > 5, 1.0
    if adaptive:
        ratio = (length - 4) * (length - 2) * endless / ((endless - 4) * (endless - 2) * length)
        rectified = ratio**0.5
    shares = (rates.decay, 1 - rates.beta1, rates.beta2, 1 - rates.beta2)
    factors = (1 - kept1, rates.rate, rates.eps, (1 - kept2) ** 0.5, rectified)
    threads = torch.get_num_threads()
    parts = (t.split(_PART) for t in (weight, gradient, moments.mean, moments.square))
    for own, d_own, mean, square in zip(*parts, strict=True):
        _csrc.radam_moments(*arrays(own, d_own, mean, square), *shares, threads)
        root = square.sqrt() if adaptive else None  # PyTorch's are not rounded as the machine's
        _csrc.radam_weights(*arrays(mean, root, own), *factors, threads)


KERNELS = Kernels("radam", cpu=_on_cpu)
