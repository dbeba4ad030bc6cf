"""RAdam for large tables, a part at a time (Liu et al., ICLR 2020)."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.optim.radam import radam

_PART = 1 << 18
"""Numbers of a part, a megabyte: large enough for threads, small enough to stay in cache with its gradients and moments."""


class RAdam(torch.optim.RAdam):
    """`torch.optim.RAdam`, bit for bit. That one passes over a whole table a dozen times, each time from memory."""

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """One step.

        Raises:
            ValueError: If there is a closure, which nothing here has.
        """
        if closure is not None:
            raise ValueError("radam: closure must be None, got one")
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"] = torch.zeros_like(parameter)
                    state["exp_avg_sq"] = torch.zeros_like(parameter)
                parts = _parts(parameter)
                radam(
                    parts,
                    _parts(parameter.grad.contiguous()),
                    _parts(state["exp_avg"]),
                    _parts(state["exp_avg_sq"]),
                    [state["step"].clone() for _ in parts],  # each part counts its own
                    foreach=False,
                    beta1=beta1,
                    beta2=beta2,
                    lr=group["lr"],
                    weight_decay=group["weight_decay"],
                    eps=group["eps"],
                )
                state["step"] += 1


def _parts(tensor: Tensor) -> list[Tensor]:
    return [*tensor.view(-1).split(_PART)]
