"""A table in Markdown, and the head that every committed file of results carries."""

import math

import pandas as pd

from vlgs.tables.fill import Cell, Filled, Place
from vlgs.tables.grid import Entry, arrange, caption, has_paper, number
from vlgs.tables.statistics import sentence


def to_markdown(filled: Filled) -> str:
    """Caption, table, what it says about the paper's claims, and where the numbers come from."""
    grid, paper = arrange(filled), has_paper(filled)
    grouped = any(line.group for line in grid.lines)
    head = [*([""] if grouped else []), "", *grid.mark_names, *grid.headers]
    rows = [head, ["---"] * len(head)]
    for line in grid.lines:
        marks = ["yes" if mark else "no" for mark in line.marks]
        marks += [""] * (len(grid.mark_names) - len(marks))
        cells = [_cell(entry, paper) for entry in line.entries]
        rows.append([*([line.group] if grouped else []), line.label, *marks, *cells])
    table = "\n".join("| " + " | ".join(row) + " |" for row in rows)
    said = [] if filled.table.by_category else [sentence(filled, m) for m in filled.table.metrics]
    notes = [f"- {row.label}: {row.ours}" for row in filled.table.rows if row.ours]
    return (
        "\n\n".join(
            [
                f"# tab:{filled.table.label}",
                caption(filled),
                table,
                *said,
                *notes,
                "\n".join(filled.provenance),
            ]
        )
        + "\n"
    )


def to_csv(filled: Filled) -> str:
    """The cells with their provenance as comment lines (`pandas.read_csv(..., comment="#")`)."""
    rows = filled.table.rows
    cells = [
        (rows[place.row].group, rows[place.row].label, place.column, place.metric, *cell)
        for place, cell in filled.cells.items()
    ]
    columns = pd.Index(("group", "label", *Place._fields[1:], *Cell._fields))
    body = pd.DataFrame(cells, columns=columns).to_csv(index=False, float_format="%.4f")
    return "".join(f"# {line}\n" for line in filled.provenance) + body


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
