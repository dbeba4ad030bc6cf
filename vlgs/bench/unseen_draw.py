"""The picture of `python -m vlgs.bench unseen`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vlgs.bench.record import COLORS, STYLE, write_figure
from vlgs.bench.unseen_row import UnseenRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = "o^sD"
"""One for each time that the colours begin again."""


def draw_unseen(stem: Path, rows: Sequence[UnseenRow]) -> None:
    """One column per scene, one panel per score; a dot per seed, a dash for its worst view, a colour and a shape per recipe."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row.scene for row in rows))
    recipes = list(dict.fromkeys((row.results_version, row.recipe) for row in rows))
    with rc_context(STYLE):
        figure = Figure(figsize=(2.8 * len(scenes) + 0.6, 4.6), layout="constrained")
        panels = figure.subplots(2, len(scenes), squeeze=False, sharey="row")
        for column, scene in enumerate(scenes):
            mine = [row for row in rows if row.scene == scene]
            for line, score in enumerate(("psnr", "miou")):
                _draw_panel(panels[line][column], mine, recipes, score)
            panels[0][column].set_title(scene, fontsize=8)
            # Photographs have no classes.
            panels[1][column].set_visible(any(row.miou is not None for row in mine))
        panels[0][0].set_ylabel("PSNR of held-out views, dB\n(dash: worst view)")
        panels[1][0].set_ylabel("mIoU of held-out views")
        # One panel may lack a recipe that another has.
        entries = {}
        for panel in panels[0]:
            handles, labels = panel.get_legend_handles_labels()
            entries |= dict(zip(labels, handles, strict=True))
        # A label is about as wide as a panel.
        columns = len(scenes)
        figure.legend(entries.values(), entries.keys(), loc="outside upper center", ncols=columns)
        write_figure(stem, figure)


def _draw_panel(
    panel: "Axes",
    rows: Sequence[UnseenRow],
    recipes: Sequence[tuple[int, str]],
    score: str,
) -> None:
    splits = sorted(dict.fromkeys(row.split for row in rows), key=_views)
    for i, (version, recipe) in enumerate(recipes):
        mine = [row for row in rows if (row.results_version, row.recipe) == (version, recipe)]
        shift = 0.5 * ((i + 0.5) / len(recipes) - 0.5)
        x = [splits.index(row.split) + shift for row in mine]
        y = [getattr(row, score) for row in mine]
        color, label = COLORS[i % len(COLORS)], f"{recipe}, results version {version}"
        marker = MARKERS[i // len(COLORS) % len(MARKERS)]
        shown = [(a, b) for a, b in zip(x, y, strict=True) if b is not None]
        if shown:
            panel.scatter(*zip(*shown, strict=True), s=9, color=color, marker=marker, label=label)
        if score == "psnr":
            panel.scatter(x, [row.worst for row in mine], s=40, marker="_", color=color)
    panel.set_xticks(range(len(splits)), splits)
    panel.set_xlim(-0.5, len(splits) - 0.5)


def _views(split: str) -> int:
    """Orders ``12 views`` before ``20 views``; ways of holding photographs out keep their order."""
    number, _, unit = split.partition(" ")
    return int(number) if unit == "views" else 0
