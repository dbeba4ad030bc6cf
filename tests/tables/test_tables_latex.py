"""Tables for LaTeX that compile, with the best in bold."""

import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest
from tables_fakes import BENCHMARK, balanced, fake_runs, filled_of, value

from vlgs.tables.benchmark import Composer
from vlgs.tables.fill import fill
from vlgs.tables.frame import tidy
from vlgs.tables.grid import arrange
from vlgs.tables.latex import to_latex
from vlgs.tables.registry import Row, Table, load_tables
from vlgs.tables.write import write_all
from vlgs.text import latex as escape

TABLES = load_tables()


def test_best_is_bold_and_second_underlined_within_a_group(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    filled = filled_of(table, tmp_path)
    lines = arrange(filled).lines
    assert [line.entries[0].rank for line in lines] == [2, 1, 0, 0]  # alone in its group: no rank
    latex = to_latex(filled)
    assert r"\textbf{51.0}" in latex
    assert r"\underline{41.0}" in latex
    assert r"\multirow{2}{*}{A: one \& all}" in latex
    assert r"\checkmark & $\times$" in latex


def test_latex_is_well_formed_and_compiles(table: Table, tmp_path: Path):
    results = tmp_path / "r"
    fake_runs(results, [table], BENCHMARK, value)
    BENCHMARK.extend(results / "synthetic" / "benchmark.yaml")
    write_all(results, [table])
    folder = results / "synthetic"
    text = (folder / "tiny.tex").read_text()
    balanced(text)
    assert r"50\% of sake\_cup \& \{more\} \#1 \$x\textasciicircum{}2 \textasciitilde{}" in text
    assert r"\input{tiny}" in (folder / "tables.tex").read_text()
    if shutil.which("pdflatex"):
        subprocess.run(
            ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "tables.tex"],
            cwd=folder,
            check=True,
            capture_output=True,
        )


@pytest.mark.parametrize("label", sorted(TABLES))
@pytest.mark.usefixtures("unchecked")
def test_every_table_of_the_registry_is_well_formed_without_a_run(label: str):
    table = TABLES[label]
    rows = tuple(
        Row(**{**vars(row), "overrides": () if row.overrides is not None else None})
        for row in table.rows  # what they override is test_tables_registry's
    )
    table = Table(**{**vars(table), "rows": rows})
    filled = fill(table, BENCHMARK, Composer(BENCHMARK), tidy([]))
    balanced(to_latex(filled))
    assert filled.cells
    assert all(pd.isna(found.mean) for found in filled.cells.values())
    assert "No runs yet" in to_latex(filled)


def test_escaping():
    assert escape("a_b%") == r"a\_b\%"
