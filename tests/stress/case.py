"""A stress case: inputs on which systems of this kind are known to fail, and what must come out."""

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor


class CannotRunError(Exception):
    """This machine lacks what the case needs; says what."""


@dataclass(frozen=True)
class Verdict:
    """What a case measured."""

    measured: str
    passed: bool


@dataclass(frozen=True)
class Case:
    """One named case; the docstring of `run` is its pass criterion."""

    name: str
    """Number in tests/README.md and a word: ``N4 needles``."""
    run: Callable[[bool], Verdict]
    """Takes whether the case is run at full size, as the command does, or small, as the tests do. May raise `CannotRunError`."""
    minutes: int = 0
    """About how long it takes one core at full size; the long ones run last."""

    @property
    def criterion(self) -> str:
        """What must hold, in words."""
        return " ".join((inspect.getdoc(self.run) or "").split())


def bound(
    measured: Mapping[str, float], limits: Mapping[str, float | int], note: str = ""
) -> Verdict:
    """Pass where every measured value is at or below its limit; a NaN is not."""
    text = ", ".join(
        f"{name} {value:.2g} (<= {limits[name]:g})" for name, value in measured.items()
    )
    passed = all(value <= limits[name] for name, value in measured.items())
    return Verdict(f"{text}; {note}" if note else text, passed)


def relative_error(got: Tensor, want: Tensor) -> float:
    """Relative error in the Euclidean norm, in float64."""
    difference = torch.linalg.vector_norm(got.double() - want.double())
    return (difference / torch.linalg.vector_norm(want.double()).clamp_min(1e-300)).item()


@contextmanager
def peak_memory() -> Iterator[Callable[[], int]]:
    """Bytes by which the peak of resident memory rose since entry, as Linux counts them."""
    status = Path("/proc/self/status")

    def read(key: str) -> int:
        line = next(line for line in status.read_text().splitlines() if line.startswith(key))
        return 1024 * int(line.split()[1])

    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from here
    start = read("VmRSS")
    yield lambda: read("VmHWM") - start
