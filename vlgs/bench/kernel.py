"""Time of the rasterizer: forward and backward, of the whole call and of blending alone."""

import csv
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import NamedTuple

import torch
from rich.table import Table

from vlgs import _csrc
from vlgs.bench.workload import Workload, make_workload
from vlgs.render import cpu, rasterize
from vlgs.report.provenance import commit, machine
from vlgs.types import RasterConfig, Rendered


class Size(NamedTuple):
    """One row of the workload and what the fastest public CPU rasterizer takes for it."""

    gaussians: int
    width: int
    height: int
    opensplat_ms: float
    """OpenSplat 15b7e800, `rasterizer/gsplat-cpu`, colour and language as two passes of three channels, forward and backward
    from projected splats; it has one thread. Median on an idle 2-core AMD EPYC (Zen 5, 4.4 GHz): other machines differ."""


SIZES = (
    Size(10_000, 320, 240, 398),
    Size(50_000, 320, 240, 483),
    Size(200_000, 320, 240, 699),
    Size(10_000, 640, 480, 1867),
    Size(50_000, 640, 480, 2160),
    Size(200_000, 640, 480, 2784),
)


@dataclass(frozen=True)
class Timing:
    """Medians over the repeats, in milliseconds of wall clock; `cpu` sums over threads."""

    gaussians: int
    width: int
    height: int
    channels: int
    """Of language; colour has 3."""
    threads: int
    part: str
    """``call``: from Gaussians to gradients of Gaussians. ``blend``: from projected splats to gradients of splats."""
    forward: float
    backward: float
    cpu: float
    opensplat: float | None
    """For the same work; none where it cannot do it."""
    isa: str


def measure_kernel(
    sizes: Sequence[Size], threads: Sequence[int], channels: Sequence[int], repeats: int
) -> list[Timing]:
    """Time every combination; `torch.set_num_threads` is left as it was."""
    timings = []
    before = torch.get_num_threads()
    for size in sizes:
        for width in channels:
            workload = make_workload(*size[:3], channels=width)
            for count in threads:
                torch.set_num_threads(count)
                for part, forward in (("call", _call(workload)), ("blend", _blend(workload))):
                    wall = _time(workload, forward, repeats)
                    peer = size.opensplat_ms if width == 3 else None
                    timings.append(Timing(*size[:3], width, count, part, *wall, peer, _csrc.isa()))
    torch.set_num_threads(before)
    return timings


def _call(w: Workload) -> Callable[[], Rendered]:
    c = w.camera
    return lambda: rasterize(
        w.means, w.quats, w.scales, w.groups, c.viewmat, c.K, c.width, c.height
    )


def _blend(w: Workload) -> Callable[[], Rendered]:
    config = RasterConfig()
    with torch.no_grad():
        splats = cpu.project(w.means, w.quats, w.scales, w.camera, config)
    leaves = cpu.Splats(
        splats.mean2d.requires_grad_(), splats.ellipse.requires_grad_(), splats.depth
    )
    return lambda: cpu.blend(leaves, w.groups, w.camera, config)


def _time(
    workload: Workload, forward: Callable[[], Rendered], repeats: int
) -> tuple[float, float, float]:
    """Medians of (forward, backward, CPU) in ms, after two runs that are not counted."""
    rows = []
    for _ in range(repeats + 2):
        for leaf in workload.leaves():
            leaf.grad = None
        cpu_start, start = time.process_time(), time.perf_counter()
        out = forward()
        middle = time.perf_counter()
        torch.autograd.backward(out.images, workload.upstream)
        end, cpu_end = time.perf_counter(), time.process_time()
        rows.append((middle - start, end - middle, cpu_end - cpu_start))
    forward_s, backward_s, cpu_s = (statistics.median(c) for c in zip(*rows[2:], strict=True))
    return 1e3 * forward_s, 1e3 * backward_s, 1e3 * cpu_s


def show_table(timings: Sequence[Timing]) -> Table:
    """The timings with their ratio to OpenSplat's."""
    table = Table(title=f"vlgs rasterizer, ms, {_csrc.isa()}")
    for name in ("Gaussians", "image", "channels", "threads", "part"):
        table.add_column(name, justify="right")
    for name in ("forward", "backward", "both", "CPU", "OpenSplat", "ratio"):
        table.add_column(name, justify="right")
    for t in timings:
        both = t.forward + t.backward
        peer = (
            ("", "") if t.opensplat is None else (f"{t.opensplat:.0f}", f"{t.opensplat / both:.1f}")
        )
        table.add_row(
            f"{t.gaussians}", f"{t.width}x{t.height}", f"3+{t.channels}", f"{t.threads}", t.part,
            f"{t.forward:.1f}", f"{t.backward:.1f}", f"{both:.1f}", f"{t.cpu:.1f}", *peer,
        )  # fmt: skip
    return table


def write_csv(timings: Sequence[Timing], path: Path) -> None:
    """One line per timing, columns named as the fields of `Timing`; comments say which machine and commit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        file.writelines(f"# {key}: {value}\n" for key, value in machine().items())
        file.write(
            f"# commit: {commit()}\n# milliseconds, medians; opensplat is its published figure\n"
        )
        writer = csv.DictWriter(file, [f.name for f in fields(Timing)])
        writer.writeheader()
        writer.writerows(asdict(t) for t in timings)
