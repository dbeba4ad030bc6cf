"""overview.png: one row per view, with the photograph, the renders and the answers as columns. Matplotlib, without a display."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vlgs.files import write_atomically
from vlgs.report import colors
from vlgs.report.draw import ViewPictures
from vlgs.text import plot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.typing import RcKeyType

STYLE: "dict[RcKeyType, Any]" = {
    "font.family": "sans-serif",
    "font.size": 8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
TILE, GAP, MARGIN = 2.2, 0.06, 0.3
"""Width of a picture, space between pictures, space around the sheet; inches."""
FOOT = 1.05
"""Height of the legend, the scales and the histogram, inches."""
DPI = 200
PNG_LEVEL = 1
"""Effort of compression: the files are a fifth larger than at Pillow's own 6 and are written in a third of the time."""
PHOTOGRAPH, RENDER, FEATURES = "photograph", "render", "language features"
LABELS, PREDICTION = "true classes", "predicted classes"
BEST = "best of the words asked"
RELEVANCY, SEGMENTATION = "relevancy of a prompt", "selected pixels, true outline"
DIFFERENCE = "indicator \N{MINUS SIGN} opacity"
COLUMNS = (PHOTOGRAPH, RENDER, FEATURES, LABELS, PREDICTION, RELEVANCY, SEGMENTATION, DIFFERENCE)
WORDS = 6
"""Words of an unlabelled scene that have a column."""


def count_difference(
    language: Float[Tensor, " n"], color: Float[Tensor, " n"], bins: int = 80
) -> Float[Tensor, " {bins}"]:
    """Density of l - o over all Gaussians, in equal bins from -1 to 1 (right of Fig. 3).

    The area under it is 1; without Gaussians it is zero.
    """
    counts = torch.histc((language - color).detach().float(), bins, min=-1, max=1)
    return counts / (counts.sum().clamp_min(1) * (2 / bins))


def write_histogram(path: Path, density: Float[Tensor, " bins"]) -> None:
    """The histogram as a picture of its own."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(4.0, 2.4))
        _draw_histogram(figure.add_axes((0.07, 0.2, 0.86, 0.76)), density)
        _save(figure, path)


def write_overview(
    path: Path,
    names: Sequence[str],
    rows: Sequence[ViewPictures],
    density: Float[Tensor, " bins"] | None,
) -> None:
    """Draw the sheet.

    Args:
        path: Ends in .png, .pdf or another format of matplotlib's.
        names: Of the classes, or of the words that are asked instead.
        rows: At least one view. A column that no row has is left out.
        density: Of l - o, see `count_difference`; None where there is none to draw.
    """
    from matplotlib import rc_context

    with rc_context(STYLE):
        _save(_Sheet(names, rows, density).figure, path)


def _save(figure: "Figure", path: Path) -> None:
    stream = io.BytesIO()
    png: dict[str, Any] = (
        {"pil_kwargs": {"compress_level": PNG_LEVEL}} if path.suffix == ".png" else {}
    )
    figure.savefig(stream, format=path.suffix[1:], dpi=DPI, **png)
    write_atomically(path, stream.getvalue(), durable=False)


@dataclass(frozen=True)
class _Tile:
    picture: UInt8[Tensor, "h w 3"]
    caption: str = ""


def _tiles(row: ViewPictures) -> dict[str, _Tile]:
    """Column -> picture of one row."""
    tiles = {
        PHOTOGRAPH: _Tile(row.photograph),
        RENDER: _Tile(row.render),
    }
    if row.features is not None:
        tiles[FEATURES] = _Tile(row.features)
    if row.difference is not None:
        tiles[DIFFERENCE] = _Tile(row.difference)
    if row.labels is not None and row.prediction is not None:
        tiles |= {LABELS: _Tile(row.labels), PREDICTION: _Tile(row.prediction)}
    elif row.prediction is not None:
        tiles[BEST] = _Tile(row.prediction)
    tiles |= {_title(word): _Tile(row.words[word]) for word in list(row.words)[:WORDS]}
    if row.prompts:
        prompt, pictures = next(iter(row.prompts.items()))
        tiles[RELEVANCY] = _Tile(pictures.relevancy, prompt)
        tiles[SEGMENTATION] = _Tile(pictures.segmentation, prompt)
    return tiles


def _title(word: str) -> str:
    """The column of a word; quotes keep it apart from the other columns."""
    return f"\N{LEFT DOUBLE QUOTATION MARK}{word}\N{RIGHT DOUBLE QUOTATION MARK}"


class _Sheet:
    """Places axes in inches from the top left, because pictures must keep their shape whatever stands around them."""

    def __init__(
        self,
        names: Sequence[str],
        rows: Sequence[ViewPictures],
        density: Float[Tensor, " bins"] | None,
    ) -> None:
        from matplotlib.figure import Figure

        tiles = [_tiles(row) for row in rows]
        words = [_title(word) for word in list(rows[0].words)[:WORDS]]
        known = [PHOTOGRAPH, RENDER, FEATURES, BEST, *words, *COLUMNS[3:]]
        columns = [c for c in known if any(c in row for row in tiles)]
        heights = [TILE * row.photograph.shape[0] / row.photograph.shape[1] for row in rows]
        self.width = 2 * MARGIN + len(columns) * (TILE + GAP)
        has_foot = not set(columns) <= {PHOTOGRAPH, RENDER, FEATURES}
        foot = FOOT if has_foot else 0
        self.height = 2 * MARGIN + sum(heights) + GAP * len(rows) + foot
        self.figure = Figure(figsize=(self.width, self.height))
        # One for all pictures: each axes takes long to make.
        sheet = self._axes(0.0, 0.0, self.width, self.height)
        sheet.set_axis_off()
        y = MARGIN
        for i, row in enumerate(tiles):
            for j, column in enumerate(columns):
                if column in row:
                    _draw_tile(sheet, row[column], self._left(j), y, heights[i])
                if i == 0:
                    self._text(self._left(j) + TILE / 2, y - 0.12, column, size=9)
            self._text(MARGIN - 0.13, y + heights[i] / 2, rows[i].name, size=7, rotation=90)
            y += heights[i] + GAP
        sheet.set(xlim=(0, self.width), ylim=(self.height, 0))
        if not has_foot:
            return
        shown = sorted({i for row in rows for i in row.classes})
        scales = [c for c in (RELEVANCY, *words[-1:]) if c in columns]
        for column in scales:
            self._heat_scale(self._left(columns.index(column)), y + 0.1)
        self._legend(names, shown, y + 0.1, columns=max(1, len(columns) - 3))
        if DIFFERENCE in columns and density is not None:
            last = self._left(columns.index(DIFFERENCE))
            _draw_histogram(self._axes(last, y + 0.1, TILE, FOOT - 0.35), density)

    def _left(self, column: int) -> float:
        return MARGIN + column * (TILE + GAP)

    def _axes(self, x: float, y: float, width: float, height: float) -> "Axes":
        bottom = 1 - (y + height) / self.height
        return self.figure.add_axes(
            (x / self.width, bottom, width / self.width, height / self.height)
        )

    def _text(self, x: float, y: float, text: str, size: int, rotation: int = 0) -> None:
        self.figure.text(
            x / self.width, 1 - y / self.height, plot(text),
            fontsize=size, rotation=rotation, ha="center", va="center",
        )  # fmt: skip

    def _legend(self, names: Sequence[str], shown: Sequence[int], y: float, columns: int) -> None:
        """Colours of the class maps that occur on the sheet."""
        from matplotlib.patches import Patch

        palette = (colors.label_colors(len(names)).double() / 255).numpy()
        handles = [Patch(color=palette[i], label=plot(names[i])) for i in shown]
        if handles:
            self.figure.legend(
                handles=handles, loc="upper left", ncols=columns, frameon=False, fontsize=8,
                handlelength=1.2, handleheight=1.2, borderpad=0, borderaxespad=0,
                bbox_to_anchor=(MARGIN / self.width, 1 - y / self.height),
            )  # fmt: skip

    def _heat_scale(self, x: float, y: float) -> None:
        axes = self._axes(x + 0.3, y, TILE - 0.6, 0.1)
        axes.imshow(colors.heat(torch.linspace(0, 1, 256)[None]).numpy(), aspect="auto")
        axes.set(xticks=[0, 255], xticklabels=["lowest", "highest"], yticks=[])
        axes.tick_params(length=0, labelsize=7)
        axes.spines[:].set_visible(False)


def _draw_tile(sheet: "Axes", tile: _Tile, x: float, y: float, height: float) -> None:
    """A picture with its top left corner at (x, y), in inches."""
    from matplotlib.patheffects import withStroke

    place = (x, x + TILE, y + height, y)
    sheet.imshow(tile.picture.numpy(), extent=place, interpolation="antialiased", aspect="auto")
    if tile.caption:
        sheet.text(
            x + 0.03 * TILE, y + 0.95 * height, plot(tile.caption), color="white", fontsize=8,
            path_effects=[withStroke(linewidth=2, foreground="black")],
        )  # fmt: skip


def _draw_histogram(axes: "Axes", density: Float[Tensor, " bins"]) -> None:
    """Bars in the colours of the l - o map, so that the histogram is also its scale."""
    from matplotlib.collections import PolyCollection

    edges = torch.linspace(-1, 1, len(density) + 1)
    centres = (edges[1:] + edges[:-1]) / 2
    fills = colors.diverging(centres[None])[0].float() / 255
    left, right, zero = edges[:-1], edges[1:], torch.zeros_like(density)
    corners = torch.stack([left, zero, left, density, right, density, right, zero], dim=1)
    # One for all bars: `axes.bar` makes a patch of each, which takes half of the picture's time.
    bars = list(corners.view(-1, 4, 2).numpy())
    axes.add_collection(PolyCollection(bars, facecolors=fills.tolist()))
    axes.stairs(density.numpy(), edges.numpy(), color="0.3", linewidth=0.6)
    axes.set(xlim=(-1, 1), xticks=[-1, -0.5, 0, 0.5, 1], yticks=[])
    axes.set_xlabel(f"{DIFFERENCE} over all Gaussians", labelpad=2)
    axes.spines["left"].set_visible(False)
