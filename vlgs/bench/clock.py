"""Timing that a busy machine disturbs as little as possible: wall and CPU time, variants in turn, quartiles."""

import itertools
import statistics
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

Key = TypeVar("Key", bound=Hashable)
Sample = TypeVar("Sample")


class Pass(NamedTuple):
    """One forward and one backward pass, milliseconds. CPU time sums over the threads of the process."""

    forward: float
    forward_cpu: float
    backward: float
    backward_cpu: float


@dataclass(frozen=True)
class Spread:
    """Milliseconds over the repeats."""

    ms: float
    """Median of wall time."""
    q1: float
    """First quartile of wall time."""
    q3: float
    """Third quartile of wall time."""
    cpu: float
    """Median of CPU time over all threads."""


def spread(walls: Sequence[float], cpus: Sequence[float]) -> Spread:
    """Medians and quartiles of at least one sample.

    Example:
        >>> spread([3.0, 1.0, 2.0], [4.0, 4.0, 4.0])
        Spread(ms=2.0, q1=1.5, q3=2.5, cpu=4.0)
    """
    if len(walls) == 1:
        return Spread(walls[0], walls[0], walls[0], cpus[0])
    q1, middle, q3 = statistics.quantiles(walls, n=4, method="inclusive")
    return Spread(middle, q1, q3, statistics.median(cpus))


def spreads(passes: Sequence[Pass]) -> tuple[Spread, Spread]:
    """Of forward and of backward."""
    forward, forward_cpu, backward, backward_cpu = zip(*passes, strict=True)
    return spread(forward, forward_cpu), spread(backward, backward_cpu)


def time_pass(
    forward: Callable[[], Sequence[Tensor]], upstream: Sequence[Tensor], leaves: Sequence[Tensor]
) -> Pass:
    """Time one forward pass and the gradients of its images.

    Args:
        forward: Makes the images.
        upstream: Gradient of a loss by each image.
        leaves: What gets gradients; those of the pass before are dropped, outside the time.
    """
    for leaf in leaves:
        leaf.grad = None
    marks = [(time.perf_counter(), time.process_time())]
    images = forward()
    marks.append((time.perf_counter(), time.process_time()))
    torch.autograd.backward(images, upstream)
    marks.append((time.perf_counter(), time.process_time()))
    steps = [
        1e3 * (b - a)
        for one, two in itertools.pairwise(marks)
        for a, b in zip(one, two, strict=True)
    ]
    return Pass(*steps)


def take_turns(
    variants: Mapping[Key, Callable[[], Sample]], repeats: int, warm_up: int = 1
) -> dict[Key, list[Sample]]:
    """Call every variant once per round, so that whatever disturbs the machine meets all of them (A B A B, not A A B B).

    Returns:
        `repeats` samples per variant; the first `warm_up` rounds are not among them.
    """
    samples: dict[Key, list[Sample]] = {key: [] for key in variants}
    for round_ in range(warm_up + repeats):
        for key, variant in variants.items():
            sample = variant()
            if round_ >= warm_up:
                samples[key].append(sample)
    return samples


@contextmanager
def replaced(owner: object, name: str, value: object) -> Iterator[None]:
    """Put something else in the place of an attribute of an object or a class, for as long as the context lasts."""
    own = vars(owner)
    there, before = name in own, own.get(name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        if there:
            setattr(owner, name, before)
        else:  # of its class
            delattr(owner, name)
