"""The layout of a table, shared by LaTeX, Markdown and HTML."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from vlgs.tables.fill import Filled, Place
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import AVERAGE

MISSING = "--"


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
    """With `by: category`: lines are categories, entries these rows of the table, and their difference."""


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
    several = len(table.metrics) > 1
    headers = tuple(
        (QUANTITIES[m].header if len(filled.columns) == 1 else f"{c} {QUANTITIES[m].header}")
        if several
        else c
        for c, m in columns
    )
    mark_names = next((tuple(row.marks) for row in table.rows if row.marks), ())
    return Grid(mark_names, columns, headers, tuple(_ranked(lines, columns)), ())


def _by_category(filled: Filled, cells: Mapping[Place, Entry]) -> Grid:
    table, metric = filled.table, filled.table.metrics[0]
    lines = []
    for category in filled.columns:
        entries = tuple(cells[Place(index, category, metric)] for index in range(len(table.rows)))
        first, last = entries[0], entries[-1]
        gain = Entry(
            last.mean - first.mean,
            math.nan,
            min(first.seeds, last.seeds),
            last.paper - first.paper,
            (last.mean - first.mean) - (last.paper - first.paper),
            first.digits,
        )
        lines.append(Line(filled.kinds.get(category, ""), category, (), (*entries, gain)))
    labels = tuple(row.label for row in table.rows)
    columns = tuple((label, metric) for label in (*labels, "Gain"))
    return Grid((), columns, (*labels, "Gain"), tuple(lines), labels)


def _ranked(lines: list[Line], columns: tuple[tuple[str, str], ...]) -> list[Line]:
    """Mark the best and the second of every column; groups are ranked apart, equal prints share a rank."""
    ranked = {}
    for group in dict.fromkeys(line.group for line in lines):
        members = [i for i, line in enumerate(lines) if line.group == group]
        for column, (_, metric) in enumerate(columns):
            quantity = QUANTITIES[metric]
            printed = {
                i: round(lines[i].entries[column].mean, quantity.digits)
                for i in members
                if math.isfinite(lines[i].entries[column].mean)
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
    """The registry's caption and what the numbers are."""
    seeds = sorted({cell.seeds for cell in filled.cells.values() if cell.seeds})
    if not seeds:
        said = "No runs yet."
    elif seeds == [1]:
        said = "One seed, hence no deviation."
    else:
        spread = "-".join(str(s) for s in sorted({seeds[0], seeds[-1]}))
        said = f"Mean +- standard deviation over {spread} seeds."
    parts = [filled.table.caption, said]
    if not filled.same_scenes and any(row.paper for row in filled.table.rows):
        parts.append(
            f"Scenes are those of {filled.benchmark.name}, not the paper's ({filled.table.dataset}), whose averages stand "
            f"beside ours for the order of rows only."
        )
    if not all(math.isfinite(cell.mean) for cell in filled.cells.values()):
        parts.append(f"{MISSING}: no run, or a score that a method does not have.")
    return " ".join(parts)


def has_paper(filled: Filled) -> bool:
    """Whether any value of the paper is printed."""
    return any(math.isfinite(cell.paper) for cell in filled.cells.values())


def average_index(grid: Grid) -> int | None:
    """Entry that holds the average."""
    return next((i for i, (column, _) in enumerate(grid.columns) if column == AVERAGE), None)
