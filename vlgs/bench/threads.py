"""The rasterizer's time by which of torch and vlgs is imported first, on an idle and on a busy machine.

Threads of OpenMP that wait spin unless the environment said otherwise when torch was loaded, which `import vlgs` sees to only if it comes
first. Those of the kernel are its own (csrc/threads.cpp), and their time should not depend on the order.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial

from rich.table import Table

from vlgs.bench.clock import Spread, spread, take_turns

FIRST = ("vlgs", "torch")
"""What is imported first."""
BUSY = "while True: pass"
WAITING = "OMP_WAIT_POLICY"
"""What says how OpenMP's threads wait; vlgs has set it in this process."""


@dataclass(frozen=True)
class ThreadsRow:
    """Forward and backward of one size, together."""

    first: str
    busy: int
    """Processes beside it that do nothing but compute."""
    time: Spread


def measure_threads(
    gaussians: int, width: int, height: int, threads: int, repeats: int
) -> list[ThreadsRow]:
    """Both orders take turns, first alone and then beside as many busy processes as there are cores, and one."""
    rows: list[ThreadsRow] = []
    size = (gaussians, width, height, threads)
    with ExitStack() as stack:
        timers = {first: stack.enter_context(_timer(first, size)) for first in FIRST}
        for busy in (0, (os.cpu_count() or 1) + 1):
            with _busy(busy):
                samples = take_turns(timers, repeats, warm_up=3)
            rows += [
                ThreadsRow(first, busy, spread(*zip(*times, strict=True)))
                for first, times in samples.items()
            ]
    return rows


def serve(size: Sequence[int]) -> None:
    """In the child: time a pass for each line of input; an answer is its wall and its CPU milliseconds."""
    from vlgs.bench.kernel import Job, time_job

    gaussians, width, height, threads = size
    job = Job(gaussians, width, height, 3, threads, "call")
    for _ in sys.stdin:
        took = time_job(job, seed=0)
        times = took.forward + took.backward, took.forward_cpu + took.backward_cpu
        sys.stdout.write(json.dumps(times) + "\n")
        sys.stdout.flush()


def show_threads(rows: Sequence[ThreadsRow]) -> Table:
    """One row per load and order."""
    table = Table(title=f"rasterizer, ms: median and quartiles; load {os.getloadavg()[0]:.1f}")
    for name in ("first import", "busy processes", "wall", "CPU"):
        table.add_column(name, justify="left" if name == "first import" else "right")
    for row in rows:
        t = row.time
        wall = f"{t.ms:.1f} [{t.q1:.1f}, {t.q3:.1f}]"
        table.add_row(row.first, str(row.busy), wall, f"{t.cpu:.1f}")
    return table


@contextmanager
def _timer(first: str, size: Sequence[int]) -> Iterator[Callable[[], tuple[float, float]]]:
    """A process that imports this first, and what asks it for a sample."""
    code = f"import {first}; from vlgs.bench.threads import serve; serve({list(size)})"
    environment = {name: value for name, value in os.environ.items() if name != WAITING}
    run = partial(subprocess.Popen[str], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with run([sys.executable, "-c", code], env=environment) as child:
        given, answers = child.stdin, child.stdout
        assert given is not None
        assert answers is not None

        def sample() -> tuple[float, float]:
            given.write("\n")
            given.flush()
            wall, cpu = json.loads(answers.readline())
            return wall, cpu

        yield sample
        given.close()


@contextmanager
def _busy(count: int) -> Iterator[None]:
    children = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()
