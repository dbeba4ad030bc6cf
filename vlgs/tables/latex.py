"""A table in LaTeX, in the paper's arrangement: groups, check marks, best bold, second underlined."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

from vlgs.tables.fill import Filled
from vlgs.tables.grid import (
    MISSING,
    Entry,
    Grid,
    Line,
    arrange,
    caption,
    has_paper,
    in_panels,
    number,
)
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import is_label
from vlgs.text import latex as escape
from vlgs.text import visible

PREAMBLE = r"""\documentclass{article}
\usepackage[a4paper,landscape,margin=15mm]{geometry}
\usepackage{amssymb,booktabs,multirow,graphicx}
"""

HEIGHT = 0.8
"""Of the page, that a table may fill beside its caption and its note."""


def to_latex(filled: Filled) -> str:
    """A `table` environment that needs booktabs, multirow, amssymb and graphicx. A wide one is panels below each other, and shrinks."""
    panels = in_panels(arrange(filled))
    return "\n".join(
        [
            *(f"% {visible(line)}" for line in filled.provenance),
            r"\begin{table}[htbp]",
            r"\centering",
            rf"\caption{{{escape(caption(filled))}}}",
            rf"\label{{tab:{filled.table.label}}}",
            *(line for panel in panels for line in _panel(filled, panel, HEIGHT / len(panels))),
            rf"\parbox{{\linewidth}}{{\footnotesize\raggedright {escape(note(filled))}}}",
            r"\end{table}",
            "",
        ]
    )


def _panel(filled: Filled, grid: Grid, height: float) -> list[str]:
    """A tabular no wider than a line and no higher than a share of the page."""
    grouped = any(line.group for line in grid.lines)
    paper = has_paper(filled)
    names = [""] * grouped + ["Category" if filled.table.by_category else "Method"]
    columns = ["l"] * len(names) + ["c"] * (len(grid.mark_names) + len(grid.headers))
    high = rf"{height:.2f}\textheight"
    body = [_line(line, grid, grouped, paper) for line in grid.lines]
    return [
        rf"\resizebox*{{!}}{{\ifdim\totalheight>{high}{high}\else\totalheight\fi}}{{%",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{{''.join(columns)}}}",
        r"\toprule",
        *_head(filled, grid, [*names, *grid.mark_names]),
        r"\midrule",
        *_with_groups(grid, body, grouped),
        r"\bottomrule",
        r"\end{tabular}}}",
        r"\par\smallskip",
    ]


def document(title: str, parts: Mapping[str, Sequence[str]]) -> str:
    """A document that inputs `<label>.tex` of every label.

    Args:
        title: Of the document.
        parts: Folder -> labels of the tables in it. The empty name is the document's own folder; each other one is a section, in which
            labels begin with its name, since two folders may have tables of one label.
    """
    return "\n".join(
        [
            PREAMBLE,
            rf"\title{{{escape(title)}}}",
            r"\begin{document}",
            *(line for folder, labels in parts.items() for line in _part(folder, labels)),
            r"\end{document}",
            "",
        ]
    )


def _part(folder: str, labels: Sequence[str]) -> Iterator[str]:
    inputs = [rf"\input{{{folder + '/' * bool(folder)}{label}}}" for label in labels]
    inputs = [f"{line}\n\\clearpage" for line in inputs]
    if not folder or not labels:
        yield from inputs
    elif is_label(folder):
        yield rf"\section*{{{escape(folder)}}}"
        yield rf"{{\let\plain\label \renewcommand{{\label}}[1]{{\plain{{{folder}:#1}}}}"
        yield from inputs
        yield "}"
    else:
        yield f"% left out, as LaTeX cannot be told this name of a folder: {visible(folder)}"


def note(filled: Filled) -> str:
    """What a reader must know of the numbers beside their caption: of how many runs, of which data and protocol. Units are in the heads."""
    counts = sorted({cell.seeds for cell in filled.cells.values() if cell.seeds})
    if not counts:
        return "No runs."
    known = [scene for scene in filled.benchmark.scenes if scene in set(filled.runs["scene"])]
    seeds = " to ".join(str(n) for n in sorted({counts[0], counts[-1]}))
    protocols = ", ".join(sorted(set(filled.runs["protocol"].dropna()))) or "not recorded"
    return (
        f"Benchmark {filled.benchmark.name}. n: {seeds} seed{'s' * (counts[-1] > 1)} on each of {len(known)} "
        f"scene{'s' * (len(known) > 1)} ({', '.join(known)}), {len(filled.runs)} runs. Protocol {protocols}; results version "
        f"{filled.results_version}. Run with {' '.join(filled.benchmark.overrides)}."
    )


def _head(filled: Filled, grid: Grid, names: Sequence[str]) -> list[str]:
    """Names of columns; where scenes have several quantities each, the scenes stand above them."""
    if filled.table.by_category or 1 in (len(filled.columns), len(filled.table.metrics)):
        return [_heads((*names, *grid.headers))]
    above, rules, at = [""] * len(names), [], len(names) + 1
    for column, entries in itertools.groupby(grid.columns, key=lambda one: one[0]):
        count = len(list(entries))
        above.append(rf"\multicolumn{{{count}}}{{c}}{{{escape(column)}}}")
        rules.append(rf"\cmidrule(lr){{{at}-{at + count - 1}}}")
        at += count
    titles = [QUANTITIES[metric].title for _, metric in grid.columns]
    return [
        " & ".join(above) + r" \\",
        " ".join(rules),
        _heads((*names, *titles)),
    ]


def _heads(names: Sequence[str]) -> str:
    return " & ".join(map(escape, names)).replace(r"10\textasciicircum{}3", "$10^3$") + r" \\"


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
