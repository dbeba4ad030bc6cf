"""What the checks of gradients share: what a check is, and its inputs."""

from collections.abc import Callable

import torch
from torch import Tensor

Check = tuple[Callable[..., object], list[Tensor]]
"""A function and inputs at which its gradient is compared with finite differences."""


def draw(*shape: int, seed: int = 0, low: float = -1.0, high: float = 1.0) -> Tensor:
    """Uniform numbers in float64, the same for the same arguments."""
    rng = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, generator=rng, dtype=torch.float64) * (high - low) + low
