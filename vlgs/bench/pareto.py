"""The Pareto front of run time and error: settings for which no other is both faster and more exact."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from vlgs.bench.record import COLORS, STYLE, plain_ticks, read_record, say, show, write_figure
from vlgs.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MEASURES = {
    "error_image_mean": "mean image error",
    "worst_gradient": "worst gradient, relative L2",
}
TRUTHS = {
    "no_cutoffs": "against float64 without cut-offs",
    "same_cutoffs": "against float64 with the same cut-offs",
}
MARKERS = {"preset": "o", "switch": "s"}


def front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Whether each point (time, error) is on the front: none other is as good in both and better in one.

    Example:
        >>> front([(1.0, 5.0), (2.0, 2.0), (3.0, 2.0), (4.0, 1.0)])
        [True, True, False, True]
    """
    return [not any(a <= x and b <= y and (a < x or b < y) for a, b in points) for x, y in points]


def run_pareto(out: Path) -> None:
    """Write pareto.csv, pareto.png and pareto_rounding.png from error.csv and print the table.

    Raises:
        FileNotFoundError: If there is no error.csv.
    """
    table = read_record(out / "error.csv")
    table["ms"] = table.forward_ms + table.backward_ms
    table["cpu_ms"] = table.forward_cpu + table.backward_cpu
    table["worst_gradient"] = table.filter(like="error_l2_").max(axis=1)
    for truth in TRUTHS:
        for measure in MEASURES:
            for _, scene in table[table.truth == truth].groupby("scene", sort=False):
                # Errors that agree to two digits are one error: below that is chance.
                errors = [float(f"{value:.1e}") for value in scene[measure]]
                ways = list(zip(map(float, scene.ms), errors, strict=True))
                table.loc[scene.index, f"front_{measure}"] = front(ways)
    _write(out, table)
    for (truth, title), name in zip(TRUTHS.items(), ("pareto", "pareto_rounding"), strict=True):
        draw_pareto(out / name, table.loc[table.truth == truth])
        _print(table.loc[table.truth == truth], title)
        say(f"picture: {out / name}.png")


def _write(out: Path, table: pd.DataFrame) -> None:
    """The points and whether they are on the front, under what error.csv says of its making."""
    source = (out / "error.csv").read_text().splitlines(keepends=True)
    header = "".join(line for line in source if line.startswith("#"))
    columns = ["scene", "truth", "variant", "group", "precision", "threads", "ms", "cpu_ms"]
    fronts = [f"front_{measure}" for measure in MEASURES]
    body = table[[*columns, *MEASURES, *fronts]].to_csv(index=False, float_format="%.6g")
    write_atomically(out / "pareto.csv", (header + body).encode())


def label_of(row: "pd.Series") -> str:
    """Short name of a point: what differs from ``default float32`` on one thread."""
    parts = [str(row.variant)]
    if row.precision != "float32":
        parts.append(str(row.precision))
    if row.threads != 1:
        parts.append(f"{row.threads}t")
    return ", ".join(parts)


def draw_pareto(stem: Path, table: pd.DataFrame) -> None:
    """One row per scene, one column per measure; log-log, the front as a line."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(table.scene))
    with rc_context(STYLE):
        figure = Figure(figsize=(10.0, 3.4 * len(scenes)), layout="constrained")
        panels = figure.subplots(len(scenes), len(MEASURES), squeeze=False)
        for scene, line in zip(scenes, panels, strict=True):
            for measure, panel in zip(MEASURES, line, strict=True):
                _draw_panel(panel, table.loc[table.scene == scene], measure)
                panel.set_title(scene, fontsize=8)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=6)
        write_figure(stem, figure)


def _draw_panel(panel: "Axes", table: pd.DataFrame, measure: str) -> None:
    # The truth itself has error 0, which no logarithm shows.
    table = table.loc[table[measure] > 0].sort_values(by="ms")
    on_front = table[table[f"front_{measure}"].astype(bool)]
    panel.plot(on_front.ms, on_front[measure], color="#888888", lw=0.8, zorder=1, label="front")
    colors = {"float32": COLORS[0], "float64": COLORS[1]}
    for _, points in table.groupby(["group", "precision", "threads"]):
        group, precision = str(points.group.iloc[0]), str(points.precision.iloc[0])
        threads = int(points.threads.iloc[0])
        hollow = threads != 1
        panel.scatter(
            points.ms, points[measure], s=18, marker=MARKERS[group], linewidths=0.8, zorder=2,
            edgecolors=colors[precision], facecolors="none" if hollow else colors[precision],
            label=f"{group}, {precision}, {threads} thread{'s' if hollow else ''}",
        )  # fmt: skip
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.margins(0.12)
    low, high = panel.get_ylim()
    # At least two decades: differences of a few per cent are not what this picture is about.
    slack = max(1.0, (100 * low / high) ** 0.5)
    panel.set_ylim(low / slack, high * slack)
    plain_ticks(panel.xaxis)
    panel.set_xlabel("forward and backward, ms (median wall clock)")
    panel.set_ylabel(MEASURES[measure])
    _write_labels(panel, table, measure)


def _write_labels(panel: "Axes", table: pd.DataFrame, measure: str) -> None:
    """Names beside the points, in a column at the right where many have nearly one error: no two on each other."""
    import numpy as np

    if table.empty:
        return
    low, high = np.log10(panel.get_ylim())
    error = np.log10(table[measure].to_numpy(float))
    # Bottom to top; among points of nearly one error the fastest comes last, so that lines fan out and do not cross.
    order = np.lexsort((-table.ms.to_numpy(float), error.round(1)))
    heights = _spread_out(((error[order] - low) / (high - low)).tolist(), gap=1.0 / 24)
    for index, height in zip(order, heights, strict=True):
        row = table.iloc[int(index)]
        panel.annotate(
            label_of(row), (row.ms, row[measure]), (1.03, height), fontsize=5.5, va="center",
            weight="bold" if bool(row[f"front_{measure}"]) else "normal", textcoords="axes fraction",
            arrowprops={"arrowstyle": "-", "lw": 0.25, "color": "#999999"},
        )  # fmt: skip


def _spread_out(wanted: Sequence[float], gap: float) -> list[float]:
    """Heights in [0, 1] near the wanted ones (ascending), at least `gap` apart where there is room for that."""
    gap = min(gap, 1.0 / max(len(wanted) - 1, 1))
    heights: list[float] = []
    for height in wanted:
        heights.append(max(float(height), heights[-1] + gap if heights else 0.0))
    ceiling = 1.0
    for i in reversed(range(len(heights))):
        heights[i] = min(heights[i], ceiling)
        ceiling = heights[i] - gap
    return heights


def _print(table: pd.DataFrame, title: str) -> None:
    lines = []
    for _, r in table.sort_values(["scene", "ms"], kind="stable").iterrows():
        marks = ["yes" if bool(r[f"front_{measure}"]) else "" for measure in MEASURES]
        errors = [f"{r[measure]:.1e}" for measure in MEASURES]
        lines.append((r.scene, label_of(r), f"{r.ms:.2f}", f"{r.cpu_ms:.2f}", *errors, *marks))
    columns = ("scene", "way", "ms", "CPU", *MEASURES.values(), "front (image)", "front (gradient)")
    show(f"run time against error, {title}", columns, lines)
