"""Time of the rasterizer: sizes, channels, threads and instruction sets; beside it the dense reference and OpenSplat's figures."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from time import sleep, thread_time
from typing import NamedTuple

import torch
from torch import Tensor

from vlgs.bench.child import Child, free_memory
from vlgs.bench.clock import Pass, Spread, spreads, take_turns, time_pass
from vlgs.bench.record import provenance, say, show, write_record
from vlgs.bench.workload import Workload, make_workload
from vlgs.ops.machine import instruction_sets, peak_fma
from vlgs.ops.project import Splats, project
from vlgs.ops.rasterize import rasterize
from vlgs.ops.rasterize_to_pixels import rasterize_to_pixels
from vlgs.types import RasterConfig

ISAS = ("v4", "v3", "base")
"""Instruction sets of the kernel, best first: AVX-512, AVX2, baseline."""

SETTLE_SECONDS = 0.05
"""Pause between two turns, because OpenMP's threads of the previous process keep spinning for a while on cores that the next one needs. One pass that does not count follows, to wake its own threads."""
REFERENCE_BYTES = 80
"""Memory of the dense reference and its gradients per Gaussian, pixel and pair of groups, bytes: an estimate, not measured."""


class Figures(NamedTuple):
    """What the same work took elsewhere: forward and backward from projected splats, ms, on a machine with `BOUND_RATE`."""

    bound: float
    """Lane-limited bound on 2 cores: live 4x4 blocks times the time of one in a loop of its own. An estimate for one kernel, no
    law of nature."""
    targets: tuple[float, float]
    """A prototype for AVX-512 with tile lists and blocks like ours, on 1 and on 2 threads: what a simple kernel reaches that has no
    fixed order of sums, no choice of channels at run time and no float64."""


class Size(NamedTuple):
    """One scene of the workload."""

    gaussians: int
    width: int
    height: int
    opensplat_ms: float | None = None
    """OpenSplat 15b7e800, `rasterizer/gsplat-cpu`, colour and language as two passes of three channels, forward and backward
    from projected splats; it has one thread. Median on an idle 2-core AMD EPYC (Zen 5, 4.4 GHz): other machines differ."""
    narrow: Figures | None = None
    """3 + 3 channels."""
    wide: Figures | None = None
    """3 + 16 channels."""

    def figures(self, channels: int) -> Figures | None:
        """Those of so many channels of language."""
        return {3: self.narrow, 16: self.wide}.get(channels)


SIZES = (
    Size(10_000, 320, 240, 398, Figures(6.1, (16.8, 9.4)), Figures(8.7, (22.9, 12.1))),
    Size(50_000, 320, 240, 483, Figures(7.7, (24.4, 12.8)), Figures(11.0, (34.6, 19.5))),
    Size(200_000, 320, 240, 699, Figures(10.7, (58.5, 32.3)), Figures(15.3, (81.8, 43.8))),
    Size(10_000, 640, 480, 1867, Figures(21.9, (58.6, 29.7)), Figures(31.3, (82.6, 42.6))),
    Size(50_000, 640, 480, 2160, Figures(25.0, (71.1, 37.0)), Figures(35.8, (103.4, 55.5))),
    Size(200_000, 640, 480, 2784, Figures(30.6, (123.0, 68.1)), Figures(43.8, (175.7, 95.0))),
)
BOUND_RATE = 9.0
"""Of the machine of `Figures` (4.45 GHz): 16-lane multiply-adds of floats per core, 1e9 per second."""
DENSE_SIZES = (Size(300, 80, 60), Size(1_000, 160, 120), Size(300, 320, 240))
"""What the dense reference can do within a few GiB."""


@dataclass(frozen=True)
class Job:
    """One thing to time; a child process gets it as it stands."""

    gaussians: int
    width: int
    height: int
    channels: int
    """Of language; colour has 3."""
    threads: int
    part: str
    """``call``: from Gaussians to gradients of Gaussians. ``blend``: from projected splats to gradients of splats.
    ``reference``: the whole call by the dense PyTorch definition."""


@dataclass(frozen=True)
class KernelRow:
    """One line of kernel.csv."""

    job: Job
    isa: str
    """``torch`` for the reference, which has no code of its own."""
    forward: Spread
    backward: Spread
    repeats: int
    opensplat_ms: float | None
    """Published, for the same work; none where it cannot do it."""
    ratio: float | None
    """OpenSplat's time over ours, forward and backward together."""
    bound_ms: float | None
    """`Figures.bound` for this machine's rate and this many threads; where it holds."""
    over_bound: float | None
    """Our time over that, forward and backward together: this compares between machines."""
    target_ms: float | None
    """`Figures.targets` for this machine's rate, where the prototype ran on as many threads."""
    over_target: float | None
    """Our time over that; below 1 is faster than the prototype."""


def run_kernel(
    sizes: Sequence[Size],
    dense_sizes: Sequence[Size],
    channels: Sequence[int],
    threads: Sequence[int],
    isas: Sequence[str],
    repeats: int,
    out: Path,
    seed: int = 0,
) -> list[KernelRow]:
    """Time every combination, print the table and write kernel.csv.

    Instruction sets (each in a process of its own), threads and parts take turns within a repeat. A combination that needs more
    memory than there is, or an instruction set that this CPU lacks, is left out with a line that says so.

    Raises:
        ValueError: If nothing is left to time.
    """
    header = provenance(seed, unit="milliseconds; opensplat_ms is its published figure")
    rows: list[KernelRow] = []
    with ExitStack() as stack:
        children = _children(isas, stack)
        # The best that the machine does, whichever sets are timed.
        rate = stack.enter_context(Child(ISAS[0])).call(multiply_add_rate)
        header["multiply_add_rate"] = f"{rate:.2f} G/s per core, 16 lanes of float"
        say(f"{rate:.2f} G multiply-adds of 16 floats per second and core")
        for size in sizes:
            for width in channels:
                parts = ("call", "blend")
                rows += _measure(children, size, width, threads, parts, repeats, seed, rate)
        for size in dense_sizes:
            parts = ("call", "reference")
            rows += _measure(children, size, 3, threads, parts, max(3, repeats // 3), seed, rate)
    write_record(out / "kernel.csv", rows, header)
    _print(rows)
    return rows


def _children(isas: Sequence[str], stack: ExitStack) -> dict[str, Child]:
    """A process for every instruction set that this CPU and this build have."""
    children: dict[str, Child] = {}
    for isa in isas:
        if isa in instruction_sets():
            children[isa] = stack.enter_context(Child(isa))
        else:
            say(f"{isa}: this CPU and this build have {' '.join(instruction_sets())}; left out")
    return children


def _measure(
    children: dict[str, Child],
    size: Size,
    channels: int,
    threads: Sequence[int],
    parts: Sequence[str],
    repeats: int,
    seed: int,
    rate: float,
) -> Iterable[KernelRow]:
    jobs = [Job(*size[:3], channels, count, part) for count in threads for part in parts]
    variants: dict[tuple[Job, str], Callable[[], Pass]] = {}
    for job in jobs:
        # The reference is the same whatever the kernel may use: one process is enough.
        for isa, child in list(children.items())[: 1 if job.part == "reference" else None]:
            variants[job, isa] = partial(_time_in, child, job, seed)
    needed = _bytes(size, channels, "reference" in parts) * len(children)
    name = f"{size.gaussians} Gaussians, {size.width}x{size.height}, 3+{channels} channels"
    if needed > free_memory():
        say(f"{name}: needs {needed / 2**30:.1f} GiB, {free_memory() / 2**30:.1f} free; left out")
        return []
    say(f"{name} ...")
    samples = take_turns(variants, repeats)
    rows = []
    for (job, isa), passes in samples.items():
        forward, backward = spreads(passes)
        peer = size.opensplat_ms if channels == 3 else None
        ratio = None if peer is None else peer / (forward.ms + backward.ms)
        isa = "torch" if job.part == "reference" else isa
        total = forward.ms + backward.ms
        bound, target = _elsewhere(size, job, rate)
        over = [None if known is None else total / known for known in (bound, target)]
        rows.append(
            KernelRow(
                job, isa, forward, backward, len(passes), peer, ratio, bound, over[0], target, over[1]
            )
        )  # fmt: skip
    return rows


def _elsewhere(size: Size, job: Job, rate: float) -> tuple[float | None, float | None]:
    """Bound and target for a machine of this rate; None where there is none for the job."""
    known = size.figures(job.channels)
    if known is None or job.part != "blend":
        return None, None
    slower = BOUND_RATE / rate
    target = known.targets[job.threads - 1] * slower if job.threads in (1, 2) else None
    return known.bound * (2 / job.threads) * slower, target


def _time_in(child: Child, job: Job, seed: int) -> Pass:
    sleep(SETTLE_SECONDS)
    if job.part != "reference":
        child.call(time_job, job, seed)
    return child.call(time_job, job, seed)


def multiply_add_rate() -> float:
    """Fused multiply-adds of 16 floats that one core does, 1e9 per second: the best of some runs of a few milliseconds.

    By CPU time. It is what a machine reaches when nothing waits, so that figures of different machines compare.
    """
    rates: list[float] = []
    for _ in range(15):
        start = thread_time()
        done = peak_fma(20_000_000)
        rates.append(done / (thread_time() - start) / 1e9)
    return max(rates)


def time_job(job: Job, seed: int) -> Pass:
    """One pass of a job in this process; the workload stays for the next call."""
    before = torch.get_num_threads()
    torch.set_num_threads(job.threads)
    try:
        w = _workload(job.gaussians, job.width, job.height, job.channels, seed)
        if job.part == "blend":
            splats, forward = _blend(w)
            leaves = [splats.mean2d, splats.ellipse, *w.leaves()[3:]]
            return time_pass(forward, w.upstream, leaves)
        backend = "reference" if job.part == "reference" else "cpu"
        return time_pass(partial(_call, w, backend), w.upstream, w.leaves())
    finally:
        torch.set_num_threads(before)


@lru_cache(maxsize=1)
def _workload(gaussians: int, width: int, height: int, channels: int, seed: int) -> Workload:
    return make_workload(gaussians, width, height, channels, seed)


def _call(w: Workload, backend: str) -> Sequence[Tensor]:
    c = w.camera
    shape = (w.means, w.quats, w.scales)
    return rasterize(
        *shape, w.groups, c.viewmat, c.K, c.width, c.height,
        backend="reference" if backend == "reference" else "cpu",
    ).images  # fmt: skip


def _blend(w: Workload) -> tuple[Splats, Callable[[], Sequence[Tensor]]]:
    config = RasterConfig()
    with torch.no_grad():
        splats = project(w.means, w.quats, w.scales, w.camera, config)
    leaves = Splats(splats.mean2d.requires_grad_(), splats.ellipse.requires_grad_(), splats.depth)
    return leaves, lambda: rasterize_to_pixels(leaves, w.groups, w.camera, config).images


def _bytes(size: Size, channels: int, dense: bool) -> int:
    """Upper estimate of one process: image, its gradient and a copy; values and gradients; 0.5 GiB for torch and lists."""
    pixels = size.width * size.height
    floats = 3 * (3 + channels) * pixels + 3 * (20 + channels) * size.gaussians
    pairs = REFERENCE_BYTES * size.gaussians * pixels if dense else 0
    return 4 * floats + pairs + (1 << 29)


def _print(rows: Sequence[KernelRow]) -> None:
    lines = []
    for r in rows:
        peer = ("", "") if r.ratio is None else (f"{r.opensplat_ms:.0f}", f"{r.ratio:.1f}")
        bound = ("", "") if r.bound_ms is None else (f"{r.bound_ms:.1f}", f"{r.over_bound:.2f}")
        target = ("", "") if r.target_ms is None else (f"{r.target_ms:.1f}", f"{r.over_target:.2f}")
        lines.append(
            (
                f"{r.job.gaussians:,}", f"{r.job.width}x{r.job.height}", f"3+{r.job.channels}",
                f"{r.job.threads}", r.isa, r.job.part,
                f"{r.forward.ms:.1f} [{r.forward.q1:.1f}, {r.forward.q3:.1f}]",
                f"{r.backward.ms:.1f} [{r.backward.q1:.1f}, {r.backward.q3:.1f}]",
                f"{r.forward.ms + r.backward.ms:.1f}", f"{r.forward.cpu + r.backward.cpu:.1f}", *peer, *bound, *target,
            )
        )  # fmt: skip
    columns = ("Gaussians", "image", "channels", "threads", "ISA", "part", "forward", "backward")
    yardsticks = ("both", "CPU", "OpenSplat", "ratio", "bound", "over it", "target", "over target")
    show(
        "rasterizer, ms: median [quartiles] of wall clock; CPU sums over threads",
        (*columns, *yardsticks),
        lines,
    )
