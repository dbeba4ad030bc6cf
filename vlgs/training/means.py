"""Sums of parameters over iterations, as a checkpoint keeps them."""

from collections.abc import Mapping

import torch
from torch import Tensor

_COUNT = ".count"


class Means:
    """Sums of parameters by name, and over how many iterations each is."""

    def __init__(self) -> None:
        self.sums: dict[str, Tensor] = {}
        self.counts: dict[str, int] = {}

    @torch.no_grad()
    def add(self, name: str, value: Tensor) -> None:
        """Count a value in.

        Example:
            >>> means = Means()
            >>> means.add("codes", torch.tensor([1.0]))
            >>> means.add("codes", torch.tensor([2.0]))
            >>> means["codes"]
            tensor([1.5000])
        """
        if name in self.sums:
            self.sums[name] += value
        else:
            self.sums[name] = value.detach().clone()
        self.counts[name] = self.counts.get(name, 0) + 1

    def __getitem__(self, name: str) -> Tensor:
        return self.sums[name] / self.counts[name]

    def state(self) -> dict[str, Tensor]:
        """Sums and counts, for a checkpoint."""
        counts = {f"{name}{_COUNT}": torch.tensor(count) for name, count in self.counts.items()}
        return {**self.sums, **counts}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Put back what `state` gave."""
        self.sums = {name: value for name, value in state.items() if not name.endswith(_COUNT)}
        self.counts = {name: int(state[f"{name}{_COUNT}"]) for name in self.sums}
