"""The layout of a table, shared by LaTeX, Markdown and HTML."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from vlgs.identity import RESULTS_VERSION
from vlgs.tables.fill import Filled, Place
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import AVERAGE

MISSING = "--"
MOST = 12
"""Numbers that stand side by side on a landscape page and can be read."""


@dataclass(frozen=True)
class Entry:
    """One printed number."""

    mean: float
    std: float
    seeds: int
    paper: float
    difference: float
    digits: int
    rank: int = 0
    """1 the best of its column and group, 2 the second, else 0."""

    @property
    def text(self) -> str:
        """Mean without deviation."""
        return number(self.mean, self.digits)


@dataclass(frozen=True)
class Line:
    """One row."""

    group: str
    label: str
    marks: tuple[bool, ...]
    entries: tuple[Entry, ...]


@dataclass(frozen=True)
class Grid:
    """Header and rows."""

    mark_names: tuple[str, ...]
    columns: tuple[tuple[str, str], ...]
    """(column, metric) of every entry of a line."""
    headers: tuple[str, ...]
    lines: tuple[Line, ...]
    per_run: tuple[str, ...]
    """With `by: category`: lines are categories, entries these rows of the table, and the first minus the last."""


def number(value: float, digits: int, signed: bool = False) -> str:
    """A number as printed, or two dashes where there is none."""
    if not math.isfinite(value):
        return MISSING
    return f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"


def arrange(filled: Filled) -> Grid:
    """Rows as lines and columns as entries; a table by category is turned round."""
    cells = {
        place: Entry(*cell, QUANTITIES[place.metric].digits) for place, cell in filled.cells.items()
    }
    if filled.table.by_category:
        return _by_category(filled, cells)
    table = filled.table
    columns = tuple((c, m) for c in filled.columns for m in table.metrics)
    lines = []
    for index, row in enumerate(table.rows):
        entries = tuple(cells[Place(index, c, m)] for c, m in columns)
        lines.append(Line(row.group, row.label, tuple(row.marks.values()), entries))
    single = len(filled.columns) == 1
    titles = {m: QUANTITIES[m].title for m in table.metrics}
    headers = tuple(titles[m] if single else f"{c} {titles[m]}" for c, m in columns)
    mark_names = next((tuple(row.marks) for row in table.rows if row.marks), ())
    return Grid(mark_names, columns, headers, tuple(_ranked(lines, columns)), ())


def in_panels(grid: Grid) -> list[Grid]:
    """A wide grid in parts that are read below each other: means over scenes first, then at most about `MOST` numbers a line.

    What is of one scene stays together.
    """
    if len(grid.columns) <= MOST:
        return [grid]
    names = list(dict.fromkeys(column for column, _ in grid.columns))
    means = [name for name in names if name == AVERAGE]
    others = [name for name in names if name != AVERAGE]
    numbers = len(grid.columns) // len(names) * len(others)
    size = math.ceil(len(others) / math.ceil(numbers / MOST))
    parts = [others[first : first + size] for first in range(0, len(others), size)]
    return [
        _chosen(grid, [i for i, (column, _) in enumerate(grid.columns) if column in part])
        for part in ([means] if means else []) + parts
    ]


def means_first(grid: Grid) -> Grid:
    """A wide grid with its means over scenes before what is of one scene, as its end is out of sight."""
    if len(grid.columns) <= MOST:
        return grid
    places = range(len(grid.columns))
    return _chosen(grid, sorted(places, key=lambda i: grid.columns[i][0] != AVERAGE))


def _chosen(grid: Grid, kept: Sequence[int]) -> Grid:
    return replace(
        grid,
        columns=tuple(grid.columns[i] for i in kept),
        headers=tuple(grid.headers[i] for i in kept),
        lines=tuple(
            replace(line, entries=tuple(line.entries[i] for i in kept)) for line in grid.lines
        ),
    )


def _by_category(filled: Filled, cells: Mapping[Place, Entry]) -> Grid:
    table, metric = filled.table, filled.table.metrics[0]
    lines = []
    for category in filled.columns:
        entries = tuple(cells[Place(index, category, metric)] for index in range(len(table.rows)))
        first, last = entries[0], entries[-1]
        less = Entry(
            first.mean - last.mean,
            math.nan,
            min(first.seeds, last.seeds),
            first.paper - last.paper,
            (first.mean - last.mean) - (first.paper - last.paper),
            first.digits,
        )
        lines.append(Line(filled.kinds.get(category, ""), category, (), (*entries, less)))
    labels = tuple(row.label for row in table.rows)
    names = (*labels, f"{labels[0]} minus {labels[-1]}")
    columns = tuple((name, metric) for name in names)
    headers = tuple(f"{name} ({QUANTITIES[metric].unit})" for name in names)
    return Grid((), columns, headers, tuple(lines), labels)


def _ranked(lines: list[Line], columns: tuple[tuple[str, str], ...]) -> list[Line]:
    """Mark the best and the second of every column; groups are ranked apart, equal prints share a rank, and one seed has none."""
    ranked = {}
    for group in dict.fromkeys(line.group for line in lines):
        members = [i for i, line in enumerate(lines) if line.group == group]
        for column, (_, metric) in enumerate(columns):
            quantity = QUANTITIES[metric]
            printed = {
                i: round(lines[i].entries[column].mean, quantity.digits)
                for i in members
                if math.isfinite(lines[i].entries[column].mean)
                and lines[i].entries[column].seeds > 1
            }
            best = sorted(set(printed.values()), reverse=quantity.higher_is_better)[:2]
            if len(best) < 2:
                continue  # nothing to compare, or all alike
            for i, value in printed.items():
                if value in best:
                    ranked[i, column] = best.index(value) + 1
    return [
        Line(
            line.group,
            line.label,
            line.marks,
            tuple(
                replace(entry, rank=ranked[i, j]) if (i, j) in ranked else entry
                for j, entry in enumerate(line.entries)
            ),
        )
        for i, line in enumerate(lines)
    ]


def caption(filled: Filled) -> str:
    """The registry's caption and what the numbers and brackets are."""
    table, benchmark = filled.table, filled.benchmark.name
    seeds = sorted({cell.seeds for cell in filled.cells.values() if cell.seeds})
    if not seeds:
        said = "No runs yet."
    elif seeds == [1]:
        said = "One seed, hence no deviation and no claim."
    else:
        spread = "-".join(str(s) for s in sorted({seeds[0], seeds[-1]}))
        said = f"Mean +- standard deviation over {spread} seeds"
        # Columns of a table by category are rows of the registry: there is nothing to rank down a column.
        said += "." if table.by_category else "; best of a group bold, second underlined."
        said += " One seed has no deviation, no rank and makes no claim." * (seeds[0] == 1)
    parts = [table.caption, said]
    if table.same_runs_as and not filled.same_scenes:
        parts.append(
            f"The same runs as in tab:{table.same_runs_as}; only the paper's values are others."
        )
    if has_paper(filled) and filled.same_scenes:
        parts.append("In brackets: the paper's value, and ours minus it.")
    elif has_paper(filled):
        parts.append(
            f"In brackets: the paper's average, of its own scenes ({table.dataset}). Ours are those of {benchmark}, so that only the "
            "order of rows can be compared."
        )
    if not all(math.isfinite(cell.mean) for cell in filled.cells.values()):
        parts.append(f"{MISSING}: no run, or a score that a method does not have.")
    if filled.results_version not in (0, RESULTS_VERSION):
        parts.append(
            f"Runs of results version {filled.results_version}, by earlier code; today's is version {RESULTS_VERSION}."
        )
    return " ".join(parts)


def has_paper(filled: Filled) -> bool:
    """Whether any value of the paper is printed."""
    return any(math.isfinite(cell.paper) for cell in filled.cells.values())
