"""A table in Markdown, and the head that every committed file of results carries."""

import math
from collections.abc import Sequence

from vlgs.tables.fill import Filled
from vlgs.tables.grid import Entry, arrange, caption, has_paper, number, provenance
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
                "\n".join(provenance(filled)),
            ]
        )
        + "\n"
    )


def to_csv(filled: Filled) -> str:
    """The cells with their provenance as comment lines (`pandas.read_csv(..., comment="#")`)."""
    head: Sequence[str] = [f"# {line}" for line in provenance(filled)]
    return (
        "\n".join(head)
        + "\n"
        + filled.cells.drop(columns="row").to_csv(index=False, float_format="%.4f")
    )


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
