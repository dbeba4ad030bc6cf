"""The progress line of an ablation, read from the files that its jobs write. It runs in a thread, as the launcher uses the main one."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.live import Live

from vlgs.ablate.job import JobOutcome, read_outcome

LOOK_SECONDS = 1.0


@dataclass(frozen=True)
class Count:
    """Runs of an ablation by state."""

    total: int
    done: int
    running: int = 0
    failed: int = 0
    seconds_per_run: float | None = None
    """Wall time of a run; None before one is known."""

    @property
    def remaining(self) -> int:
        """Runs that are not done and have not failed, those that run included."""
        return self.total - self.done - self.failed

    def line(self) -> str:
        """One line for people.

        Example:
            >>> Count(total=12, done=4, running=2, failed=1, seconds_per_run=40.0).line()
            '12 runs: 4 done, 2 running, 1 failed, 7 remaining, about 2 min left'
        """
        parts = [f"{self.done} done", f"{self.running} running", f"{self.failed} failed"]
        left = ""
        if self.remaining and self.seconds_per_run is not None:
            # Those that run are half done on average.
            work = (self.remaining - 0.5 * self.running) * self.seconds_per_run
            left = f", about {duration(work / max(self.running, 1))} left"
        return f"{self.total} runs: {', '.join(parts)}, {self.remaining} remaining{left}"


def duration(seconds: float) -> str:
    """A duration in seconds, minutes or hours.

    Example:
        >>> duration(42.0), duration(600.0), duration(9000.0)
        ('42 s', '10 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def count(before: Count, outcomes: Sequence[JobOutcome]) -> Count:
    """State of an ablation from what was known before a launch and what its jobs have written since.

    The time of a run is the mean of those of this launch that ended well, else what was known before.
    """
    ended = [o.seconds for o in outcomes if o.done]
    return Count(
        before.total,
        before.done + len(ended),
        sum(o.status is None and bool(o.log) for o in outcomes),
        before.failed + sum(not (o.done or o.busy or o.lost) for o in outcomes),
        sum(ended) / len(ended) if ended else before.seconds_per_run,
    )


@contextmanager
def shown(console: Console, before: Count, folder: Path, numbers: range) -> Iterator[None]:
    """Keep one line up to date; where the output is no terminal, print one whenever a run has ended.

    Args:
        console: Where to.
        before: What was known before the launch.
        folder: Where the jobs write.
        numbers: Of the jobs.
    """
    finished: dict[int, JobOutcome] = {}

    def look() -> Count:
        outcomes = []
        for number in numbers:
            outcome = finished.get(number) or read_outcome(folder, number)
            if outcome.status is not None:
                finished[number] = outcome
            outcomes.append(outcome)
        return count(before, outcomes)

    over = threading.Event()
    with Live(look().line(), console=console, auto_refresh=False, transient=True) as live:

        def keep() -> None:
            said = -1
            while not over.wait(LOOK_SECONDS):
                now = look()
                live.update(now.line(), refresh=console.is_terminal)
                if not console.is_terminal and len(finished) != said:
                    said = len(finished)
                    console.print(now.line())

        thread = threading.Thread(target=keep, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
