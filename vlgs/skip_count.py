"""Counts what training skipped, how often, and the time that this saved."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

WORK = {
    "blend_zero": "blended render",
    "blend_small": "blended render",
    "blend_reuse": "blended render",
    "similarity_cache": "similarity",
    "frozen_weights": "weights",
    "frozen_color": "color render",
}
"""Name of a skip, in `vlgs.skips` -> the work that it saves."""


@dataclass
class Work:
    """How often a piece of work was done, and for how long."""

    done: int = 0
    seconds: float = 0.0
    """Wall time of the forward pass; its share of the backward pass cannot be measured separately."""


@dataclass
class SkipCount:
    """Counts of one run over all its resumes."""

    work: dict[str, Work] = field(default_factory=dict)
    skipped: dict[str, int] = field(default_factory=dict)
    similarities: dict[tuple[int, int], float] = field(default_factory=dict)
    """SSIM(I1, I2) per pair of views: constant, so computed once (conf/README.md, D.12)."""

    @contextmanager
    def doing(self, work: str, count: int = 1) -> Iterator[None]:
        """Count and time a piece of work; `count` units of it, e.g. Gaussians."""
        started = time.perf_counter()
        yield
        self.add(work, count, time.perf_counter() - started)

    def add(self, work: str, count: int, seconds: float) -> None:
        """Count work that was timed elsewhere."""
        entry = self.work.setdefault(work, Work())
        entry.done += count
        entry.seconds += seconds

    def skip(self, name: str, count: int = 1) -> None:
        """Count work that was left out, by the name of the skip."""
        assert name in WORK
        self.skipped[name] = self.skipped.get(name, 0) + count

    def done(self, work: str) -> int:
        """How often a piece of work was done."""
        return self.work.get(work, Work()).done

    def report(self) -> dict[str, dict[str, float | int | None]]:
        """Per skip that left something out: how much, of how much, and an estimate of the seconds saved.

        The estimate is the mean cost of that work in this run times the count; None where it was never done.
        """
        return {name: self._entry(name, count) for name, count in sorted(self.skipped.items())}

    def _entry(self, name: str, count: int) -> dict[str, float | int | None]:
        work = self.work.get(WORK[name], Work())
        others = sum(n for other, n in self.skipped.items() if WORK[other] == WORK[name])
        return {
            "skipped": count,
            "share": count / (work.done + others),
            "seconds_saved": count * work.seconds / work.done if work.done else None,
        }

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps: plain JSON."""
        return {
            "work": {name: asdict(work) for name, work in self.work.items()},
            "skipped": dict(self.skipped),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state` returned."""
        self.work = {name: Work(**work) for name, work in state.get("work", {}).items()}
        self.skipped = dict(state.get("skipped", {}))
