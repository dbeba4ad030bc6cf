"""How time grows with Gaussians, pixels, channels and threads."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from vlgs.bench.child import free_memory
from vlgs.bench.clock import Spread, spreads, take_turns
from vlgs.bench.outcome import time_render
from vlgs.bench.record import (
    COLORS,
    STYLE,
    plain_ticks,
    provenance,
    say,
    show,
    write_figure,
    write_record,
)
from vlgs.bench.workload import make_workload
from vlgs.types import RasterConfig

if TYPE_CHECKING:
    from matplotlib.axes import Axes

AXES = {
    "gaussians": "Gaussians",
    "pixels": "pixels",
    "channels": "language channels",
    "threads": "threads",
}
"""What grows, one series each."""
COUNTS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
IMAGES = ((160, 120), (320, 240), (640, 480), (1280, 720), (1920, 1080))
CHANNELS = (1, 3, 8, 16, 32, 64, 128, 256, 512)


@dataclass(frozen=True)
class Point:
    """One scene of one series."""

    axis: str
    """What grows: a key of `AXES`. About as many Gaussians cover a pixel everywhere, so that work is pixels x channels
    plus what each Gaussian costs by itself."""
    value: int
    gaussians: int
    width: int
    height: int
    channels: int
    threads: int


@dataclass(frozen=True)
class GrowthRow:
    """One line of growth.csv."""

    point: Point
    forward: Spread
    backward: Spread
    repeats: int
    slope: float | None
    """Exponent since the point before: log of the ratio of wall times over log of the ratio of values."""


def make_points(quick: bool) -> list[Point]:
    """All series, small ones with `quick`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = sorted({2**i for i in range(int(math.log2(cores or 1)) + 1)} | {1, 2, cores or 1})
    if quick:
        points = [Point("gaussians", n, n, 64, 48, 3, 1) for n in (200, 400)]
        points += [Point("pixels", w * h, 200, w, h, 3, 1) for w, h in ((32, 24), (64, 48))]
        points += [Point("channels", c, 200, 64, 48, c, 1) for c in (1, 8)]
        return points + [Point("threads", t, 400, 64, 48, 3, t) for t in (1, 2)]
    points = [Point("gaussians", n, n, 320, 240, 3, 1) for n in COUNTS]
    points += [Point("pixels", w * h, 50_000, w, h, 3, 1) for w, h in IMAGES]
    points += [Point("channels", c, 10_000, 320, 240, c, 1) for c in CHANNELS]
    return points + [Point("threads", t, 200_000, 640, 480, 3, t) for t in threads]


def run_growth(points: Sequence[Point], repeats: int, out: Path, seed: int) -> list[GrowthRow]:
    """Time every series, its points in turn; write growth.csv and growth.png, print the table."""
    header = provenance(seed, unit="milliseconds of wall clock (cpu: of all threads)")
    rows: list[GrowthRow] = []
    for axis in dict.fromkeys(point.axis for point in points):
        say(f"{AXES[axis]} ...")
        rows += _measure([p for p in points if p.axis == axis], repeats, seed)
    write_record(out / "growth.csv", rows, header)
    draw_growth(out / "growth", rows)
    _print(rows)
    return rows


def slope(before: tuple[float, float], after: tuple[float, float]) -> float:
    """Exponent between two points (value, time) of a power law.

    Example:
        >>> slope((10.0, 1.0), (100.0, 10.0))
        1.0
    """
    return math.log(after[1] / before[1]) / math.log(after[0] / before[0])


def _measure(points: Sequence[Point], repeats: int, seed: int) -> list[GrowthRow]:
    kept, budget = {}, free_memory() // 2
    for p in points:
        values = p.width * p.height * (3 + p.channels) + p.gaussians * (20 + p.channels)
        budget -= 4 * 4 * values
        if budget < 0:
            say(f"{p.axis} = {p.value}: not enough memory; left out")
            continue
        w = make_workload(p.gaussians, p.width, p.height, p.channels, seed)
        kept[p] = partial(time_render, w, RasterConfig(), p.threads)
    rows: list[GrowthRow] = []
    for p, passes in take_turns(kept, repeats).items():
        forward, backward = spreads(passes)
        exponent = None
        if rows:
            last = rows[-1]
            before = float(last.point.value), last.forward.ms + last.backward.ms
            exponent = slope(before, (float(p.value), forward.ms + backward.ms))
        rows.append(GrowthRow(p, forward, backward, repeats, exponent))
    return rows


def draw_growth(stem: Path, rows: Sequence[GrowthRow]) -> None:
    """One panel per series, log-log, quartiles as bars; dashed is proportional growth (threads: ideal)."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    axes = list(dict.fromkeys(row.point.axis for row in rows))
    with rc_context(STYLE):
        figure = Figure(figsize=(2.6 * len(axes), 2.6), layout="constrained")
        for i, axis in enumerate(axes):
            panel = figure.add_subplot(1, len(axes), i + 1)
            _draw_series(panel, axis, [row for row in rows if row.point.axis == axis])
            if i == 0:
                panel.set_ylabel("milliseconds, median and quartiles")
                panel.legend()
        write_figure(stem, figure)


def _draw_series(panel: "Axes", axis: str, rows: Sequence[GrowthRow]) -> None:
    x = [row.point.value for row in rows]
    for name, color in (("forward", COLORS[0]), ("backward", COLORS[1])):
        times: list[Spread] = [getattr(row, name) for row in rows]
        y = [t.ms for t in times]
        bars = [[t.ms - t.q1 for t in times], [t.q3 - t.ms for t in times]]
        panel.errorbar(x, y, yerr=bars, marker="o", ms=3, lw=1, color=color, label=name)
        power, meaning = (-1, "ideal") if axis == "threads" else (1, "proportional")
        anchor = 0 if axis == "threads" else -1
        line = [y[anchor] * (value / x[anchor]) ** power for value in x]
        panel.plot(x, line, ls="--", lw=0.6, color=color, label=f"{name}, {meaning}")
    panel.set_xscale("log")
    panel.set_yscale("log")
    plain_ticks(panel.yaxis)
    if axis == "threads":
        panel.set_xticks(x, [str(value) for value in x])
        panel.set_xticks([], minor=True)
    elif max(x) < 100 * min(x):
        plain_ticks(panel.xaxis)
    panel.set_xlabel(AXES[axis])
    panel.set_title(_fixed(rows[0].point), fontsize=7)


def _fixed(p: Point) -> str:
    """What does not grow in a point's series."""
    parts = {
        "gaussians": f"{p.gaussians:,} Gaussians",
        "pixels": f"{p.width}x{p.height}",
        "channels": f"3+{p.channels} channels",
        "threads": f"{p.threads} thread",
    }
    return ", ".join(text for axis, text in parts.items() if axis != p.axis)


def _print(rows: Sequence[GrowthRow]) -> None:
    lines = []
    for first, r in pairwise([None, *rows]):
        assert r is not None
        p = r.point
        lines.append(
            (
                p.axis if first is None or first.point.axis != p.axis else "",
                f"{p.gaussians:,}", f"{p.width}x{p.height}", f"3+{p.channels}", f"{p.threads}",
                f"{r.forward.ms:.2f} [{r.forward.q1:.2f}, {r.forward.q3:.2f}]",
                f"{r.backward.ms:.2f} [{r.backward.q1:.2f}, {r.backward.q3:.2f}]",
                f"{r.forward.cpu + r.backward.cpu:.2f}", "" if r.slope is None else f"{r.slope:.2f}",
            )
        )  # fmt: skip
    columns = ("grows", "Gaussians", "image", "channels", "threads", "forward", "backward", "CPU")
    show("growth, ms: median [quartiles] of wall clock; slope: exponent since the line above", (*columns, "slope"), lines)  # fmt: skip
