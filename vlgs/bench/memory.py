"""Peak memory of one forward and backward pass, in a process of its own that has done nothing else."""

import multiprocessing
import resource
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from vlgs.bench.outcome import time_render
from vlgs.bench.scenes import load_workload
from vlgs.types import RasterConfig

MIB = 1 << 20


@dataclass(frozen=True)
class Memory:
    """Peak of a process that renders once, forward and backward."""

    rss_mib: float
    """All of it: Python, torch, the scene."""
    extra_mib: float
    """What rendering added to what was there before it."""


def measure_memory(path: Path, config: RasterConfig, threads: int) -> Memory:
    """Render the workload that lies at `path`; see `Memory`.

    The process is forked from one that has imported this module and nothing more, so that it starts at once and small.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(_measure, path, config, threads).result()


def _measure(path: Path, config: RasterConfig, threads: int) -> Memory:
    w = load_workload(path)
    before = _resident()
    time_render(w, config, threads)
    peak = peak_bytes()
    return Memory(peak / MIB, (peak - before) / MIB)


def _resident() -> int:
    return _status("VmRSS") or peak_bytes()


def peak_bytes() -> int:
    """The most memory that this process has held."""
    # getrusage's figure survives fork and exec, so that it may be the parent's: Linux knows better.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return _status("VmHWM") or (peak if sys.platform == "darwin" else 1024 * peak)


def _status(key: str) -> int | None:
    """Bytes of a line of /proc/self/status; None where there is none."""
    try:
        with open("/proc/self/status") as file:
            fields = dict(line.split(":", 1) for line in file)
        return 1024 * int(fields[key].split()[0])
    except (OSError, KeyError, ValueError):
        return None
