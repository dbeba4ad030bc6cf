"""Pictures of the report: the rows of a table, run time against mIoU, learning curves, l - o by kind. Matplotlib, no display."""

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vlgs.tables.fill import Filled
from vlgs.tables.grid import Line, arrange
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import AVERAGE
from vlgs.text import plot

STYLE: Mapping[Any, Any] = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "legend.frameon": False,
}
COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")
"""Told apart by colour-blind eyes too (Tol's bright scheme)."""


def rows_compared(filled: Filled) -> bytes | None:
    """First metric of every row, with the deviation over seeds; by scene tables show their average, or their only scene.

    Returns:
        A PNG file, or None where no row has a number.
    """
    grid = arrange(filled)
    last = len(grid.columns) - 1 if filled.table.by_category else 0
    metric = filled.table.metrics[0]
    chosen = [
        i for i, (column, name) in enumerate(grid.columns) if column == AVERAGE and name == metric
    ]
    series = list(range(last)) if filled.table.by_category else chosen or [0]
    lines = [
        line for line in grid.lines if any(math.isfinite(line.entries[i].mean) for i in series)
    ]
    if not lines:
        return None
    with png(6.4, 0.6 + 0.16 * len(lines) * max(len(series), 1.6)) as (axes, file):
        _draw(axes, lines, series, grid.headers)
        quantity = QUANTITIES[metric]
        bars = any(math.isfinite(line.entries[i].std) for line in lines for i in series)
        axes.set_xlabel(quantity.title + "; bars: one standard deviation over seeds" * bars)
        if len(series) > 1:
            axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return file.getvalue()


def time_against_score(frame: pd.DataFrame, labels: Mapping[str, str]) -> bytes | None:
    """Training time against mIoU: one point per recipe, mean over its scenes and seeds.

    Args:
        frame: As `vlgs.tables.frame.tidy` returns it, of one benchmark.
        labels: Recipe -> what to call it.

    Returns:
        A PNG file, or None without runs.
    """
    wide = frame[frame["metric"].isin(["miou", "train_seconds"])].pivot_table(
        index="recipe", columns="metric", values="value", aggfunc="mean"
    )
    if wide.empty or not {"miou", "train_seconds"} <= set(wide.columns):
        return None
    wide = wide.dropna()
    with png(6.4, 4.0) as (axes, file):
        for index, (recipe, row) in enumerate(wide.iterrows()):
            color = COLORS[index % len(COLORS)]
            axes.plot(row["train_seconds"], 100 * row["miou"], "o", color=color, markersize=4)
            axes.annotate(
                plot(labels.get(str(recipe), str(recipe))),
                (row["train_seconds"], 100 * row["miou"]),
                xytext=(4, 3),
                textcoords="offset points",
                fontsize=6,
            )
        axes.set_xlabel("training (s)")
        axes.set_ylabel("mIoU (%)")
    return file.getvalue()


def learning_curves(curves: Mapping[str, Sequence[pd.DataFrame]]) -> bytes | None:
    """PSNR of the training views over the iterations; one colour per scene, one line per seed.

    Args:
        curves: Scene -> contents of log.csv, one per seed.
    """
    if not any(curves.values()):
        return None
    with png(6.4, 3.0) as (axes, file):
        for index, (scene, runs) in enumerate(curves.items()):
            for number, run in enumerate(runs):
                axes.plot(
                    run["step"],
                    run["psnr"],
                    color=COLORS[index % len(COLORS)],
                    linewidth=0.8,
                    label=plot(scene) if number == 0 else None,
                )
        axes.set_xlabel("iteration")
        axes.set_ylabel("PSNR of the training views (dB)")
        axes.legend()
    return file.getvalue()


def indicator_by_kind(histograms: Sequence[Mapping[str, Sequence[float]]]) -> bytes | None:
    """Share of pixels by l - o, mean over runs; one line per kind of category.

    Args:
        histograms: The entry ``indicator`` of metrics.json of some runs.
    """
    if not histograms:
        return None
    kinds = sorted({kind for one in histograms for kind in one if kind != "edges"})
    edges = histograms[0]["edges"]
    with png(6.4, 2.6) as (axes, file):
        for index, kind in enumerate(kinds):
            rows = pd.DataFrame([one[kind] for one in histograms if kind in one])
            name = plot(kind.replace("_", " or "))
            color = COLORS[index % len(COLORS)]
            axes.stairs(rows.mean().to_numpy(), edges, color=color, label=name)
        axes.set_xlabel("l - o")
        axes.set_ylabel("share of pixels")
        axes.set_yscale("log")
        axes.legend()
    return file.getvalue()


@contextmanager
def png(width: float, height: float) -> Iterator[tuple[Axes, io.BytesIO]]:
    """A figure of that size in inches, and the file that it becomes in the end."""
    file = io.BytesIO()
    with rc_context(dict(STYLE)):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure.add_subplot(), file
        figure.savefig(file, format="png", dpi=110, metadata={"Software": None})


def _draw(axes: Axes, lines: Sequence[Line], series: Sequence[int], headers: Sequence[str]) -> None:
    """Points with error bars: rows lie close together, and a bar that does not start at zero misleads."""
    for number, index in enumerate(series):
        entries = [line.entries[index] for line in lines]
        shift = 0.5 * ((number + 0.5) / len(series) - 0.5)
        axes.errorbar(
            [entry.mean for entry in entries],
            [i + shift for i in range(len(lines))],
            xerr=[0.0 if math.isnan(entry.std) else entry.std for entry in entries],
            fmt="o",
            markersize=4,
            elinewidth=0.8,
            color=COLORS[number % len(COLORS)],
            label=plot(headers[index]),
        )
    axes.set_yticks(range(len(lines)), [_title(line) for line in lines])
    axes.invert_yaxis()
    axes.grid(axis="both", linewidth=0.3)


def _title(line: Line) -> str:
    letter, colon, _ = line.group.partition(":")
    return plot(f"{letter}: {line.label}" if colon else line.label)
