"""Small tables of Gaussians that densification is asked to change, and what asks it."""

import math

import torch
from torch import nn

from vlgs.gaussians import (
    STANDARD,
    DensifyReport,
    DensifyState,
    GaussiansConfig,
    densify,
)

PARAMETERS = tuple(STANDARD)[:8]
"""What every training has."""

EXTENT = 1.0
SMALL, MIDDLE, LARGE = 0.005, 0.05, 0.5
EARLY, LATE = 600, 3100  # before and after the first reset


def make(n: int, scale: float = SMALL, opacity: float = 0.5, indicator: float = 0.5):
    generator = torch.Generator().manual_seed(n)
    logit = lambda p: math.log(p / (1 - p))  # noqa: E731
    values = {
        "means": torch.randn(n, 3, generator=generator),
        "quats": torch.randn(n, 4, generator=generator),
        "log_scales": torch.full((n, 3), math.log(scale)),
        "sh0": torch.randn(n, 3, generator=generator),
        "shN": torch.randn(n, 3, 3, generator=generator),
        "opacity_logits": torch.full((n,), logit(opacity)),
        "indicator_logits": torch.full((n,), logit(indicator)),
        "features": torch.randn(n, 2, generator=generator),
    }
    return nn.ParameterDict({name: nn.Parameter(values[name]) for name in PARAMETERS})


def adam(params: nn.ParameterDict, **options) -> torch.optim.Adam:
    groups = [{"params": [params[name]], "name": name, "lr": 1e-3} for name in PARAMETERS]
    return torch.optim.Adam(groups, **options)


def step_once(params: nn.ParameterDict, optimizer: torch.optim.Adam) -> None:
    """One step with a gradient of its own for every row, so that a moment tells whose it is."""
    for value in params.values():
        rows = torch.arange(1.0, len(value) + 1).reshape(-1, *[1] * (value.dim() - 1))
        value.grad = rows.expand_as(value).clone()
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)


def state_of(grads: list[float]) -> DensifyState:
    return DensifyState(torch.tensor(grads), torch.ones(len(grads)))


def run(params, state, config=None, optimizer=None, step=EARLY, seed=0) -> DensifyReport:
    optimizer = adam(params) if optimizer is None else optimizer
    config = GaussiansConfig() if config is None else config
    return densify(params, optimizer, state, config, EXTENT, seed, step)


HOT, COLD = 1e-3, 1e-5
