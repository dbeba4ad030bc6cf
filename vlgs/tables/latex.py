"""A table in LaTeX, in the paper's arrangement: groups, check marks, best bold, second underlined."""

import math
from collections.abc import Sequence

from vlgs.tables.fill import Filled
from vlgs.tables.grid import (
    MISSING,
    Entry,
    Grid,
    Line,
    arrange,
    caption,
    has_paper,
    number,
)
from vlgs.text import latex as escape
from vlgs.text import visible

PREAMBLE = r"""\documentclass{article}
\usepackage[a4paper,landscape,margin=15mm]{geometry}
\usepackage{amssymb,booktabs,multirow,graphicx}
"""


def to_latex(filled: Filled) -> str:
    """A `table` environment that needs booktabs, multirow and amssymb."""
    grid = arrange(filled)
    grouped = any(line.group for line in grid.lines)
    paper = has_paper(filled)
    lead = ["l"] * grouped + ["l"] + ["c"] * len(grid.mark_names)
    numbers = ["c"] * len(grid.headers)
    names = [""] * grouped + ["Category" if filled.table.by_category else "Method"]
    head = [*map(escape, names), *map(escape, grid.mark_names), *map(escape, grid.headers)]
    body = [_line(line, grid, grouped, paper) for line in grid.lines]
    rows = _with_groups(grid, body, grouped)
    return "\n".join(
        [
            *(f"% {visible(line)}" for line in filled.provenance),
            r"\begin{table}[htbp]",
            r"\centering",
            rf"\caption{{{escape(caption(filled))}}}",
            rf"\label{{tab:{filled.table.label}}}",
            r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
            rf"\begin{{tabular}}{{{''.join([*lead, *numbers])}}}",
            r"\toprule",
            " & ".join(head) + r" \\",
            r"\midrule",
            *rows,
            r"\bottomrule",
            r"\end{tabular}}",
            r"\end{table}",
            "",
        ]
    )


def document(title: str, labels: Sequence[str]) -> str:
    """A document that inputs `<label>.tex` of every label from its own folder."""
    inputs = [rf"\input{{{label}}}" + "\n" + r"\clearpage" for label in labels]
    return "\n".join(
        [
            PREAMBLE,
            rf"\title{{{escape(title)}}}",
            r"\begin{document}",
            *inputs,
            r"\end{document}",
            "",
        ]
    )


def _line(line: Line, grid: Grid, grouped: bool, paper: bool) -> str:
    marks = [r"\checkmark" if mark else r"$\times$" for mark in line.marks]
    marks += [""] * (len(grid.mark_names) - len(marks))
    cells = [_cell(entry, paper) for entry in line.entries]
    return " & ".join([*([""] if grouped else []), escape(line.label), *marks, *cells]) + r" \\"


def _cell(entry: Entry, paper: bool) -> str:
    if not math.isfinite(entry.mean):
        text = MISSING
    else:
        text = entry.text
        if entry.rank == 1:
            text = rf"\textbf{{{text}}}"
        elif entry.rank == 2:
            text = rf"\underline{{{text}}}"
        if math.isfinite(entry.std):
            text += rf" {{\scriptsize $\pm$ {number(entry.std, entry.digits)}}}"
    if paper and math.isfinite(entry.paper):
        beside = number(entry.paper, entry.digits)
        if math.isfinite(entry.difference):
            beside += f", {number(entry.difference, entry.digits, signed=True)}"
        text += rf" {{\scriptsize ({beside})}}"
    return text


def _with_groups(grid: Grid, body: Sequence[str], grouped: bool) -> list[str]:
    """Put each group's name beside its first line and a rule between groups."""
    if not grouped:
        return list(body)
    rows: list[str] = []
    counts = {g: sum(line.group == g for line in grid.lines) for g in {x.group for x in grid.lines}}
    before = None
    for line, text in zip(grid.lines, body, strict=True):
        if line.group != before:
            if before is not None:
                rows.append(r"\midrule")
            text = rf"\multirow{{{counts[line.group]}}}{{*}}{{{escape(line.group)}}}" + text
        before = line.group
        rows.append(text)
    return rows
