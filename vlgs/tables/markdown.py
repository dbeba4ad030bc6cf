"""Tables as Markdown and CSV."""

import math
from collections.abc import Sequence

from vlgs.tables.fill import Cell, Filled, Place
from vlgs.tables.grid import Entry, Grid, arrange, caption, has_paper, in_panels, number
from vlgs.tables.said import say
from vlgs.text import csv_line, visible
from vlgs.text import markdown as escape


def to_markdown(filled: Filled) -> str:
    """Caption, table, what may be claimed of it, and where the numbers come from."""
    paper = has_paper(filled)
    said = say(filled)
    claims = [said.head, ["---"] * len(said.head), *said.lines] if said.lines else []
    paragraphs = [
        escape(said.before),
        _table([[*map(escape, r)] for r in claims]),
        escape(said.after),
    ]
    notes = [f"- {escape(row.label)}: {escape(row.ours)}" for row in filled.table.rows if row.ours]
    return (
        "\n\n".join(
            [
                f"# tab:{filled.table.label}",
                escape(caption(filled)),
                *(_table(_rows(panel, paper)) for panel in in_panels(arrange(filled))),
                *filter(None, paragraphs),
                *notes,
                "\n".join(map(escape, filled.provenance)),
            ]
        )
        + "\n"
    )


def _rows(grid: Grid, paper: bool) -> list[list[str]]:
    """Header, rule and lines."""
    grouped = any(line.group for line in grid.lines)
    head = [*([""] if grouped else []), "", *map(escape, (*grid.mark_names, *grid.headers))]
    rows = [head, ["---"] * len(head)]
    for line in grid.lines:
        marks = ["yes" if mark else "no" for mark in line.marks]
        marks += [""] * (len(grid.mark_names) - len(marks))
        cells = [_cell(entry, paper) for entry in line.entries]
        rows.append(
            [*([escape(line.group)] if grouped else []), escape(line.label), *marks, *cells]
        )
    return rows


def to_csv(filled: Filled) -> str:
    """The cells with their provenance as comment lines (`pandas.read_csv(..., comment="#")`)."""
    rows = filled.table.rows
    cells = [
        (rows[place.row].group, rows[place.row].label, place.column, place.metric, *cell)
        for place, cell in filled.cells.items()
    ]
    head = ("group", "label", *Place._fields[1:], *Cell._fields)
    lines = [f"# {visible(line)}" for line in filled.provenance]
    return "\n".join([*lines, *(csv_line(row, digits=4) for row in [head, *cells]), ""])


def _table(rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _cell(entry: Entry, paper: bool) -> str:
    text = entry.text
    if math.isfinite(entry.std):
        text += f" ± {number(entry.std, entry.digits)}"
    if entry.rank == 1:
        text = f"**{text}**"
    elif entry.rank == 2:
        text = f"<u>{text}</u>"
    if paper and math.isfinite(entry.paper):
        beside = f"paper {number(entry.paper, entry.digits)}"
        if math.isfinite(entry.difference):
            beside += f", {number(entry.difference, entry.digits, signed=True)}"
        text += f" ({beside})"
    return text
