"""RAdam for large tables (Liu et al., ICLR 2020)."""

from collections.abc import Callable
from typing import Any

import torch

from vlgs.ops.radam import Moments, Rates, radam_step


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
                state["step"] += 1
                rates = Rates(
                    group["lr"],
                    beta1,
                    beta2,
                    group["eps"],
                    group["weight_decay"],
                    state["step"].item(),
                )
                moments = Moments(state["exp_avg"].view(-1), state["exp_avg_sq"].view(-1))
                gradient = parameter.grad.contiguous().view(-1)
                radam_step(parameter.detach().view(-1), gradient, moments, rates)
