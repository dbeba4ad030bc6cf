"""From runs to numbers: every number at its place, nothing filled in."""

import re
from pathlib import Path

import pandas as pd
import pytest
from tables_fakes import BENCHMARK, balanced, cell, fake_runs, filled_of, value

from vlgs.tables.benchmark import Benchmark
from vlgs.tables.frame import read_metrics, require_one_meaning, tidy, to_lines
from vlgs.tables.grid import arrange
from vlgs.tables.latex import to_latex
from vlgs.tables.registry import Table, load_table


def test_means_and_deviations_are_those_of_the_runs(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    filled = filled_of(table, tmp_path)
    full = cell(filled, 1, "mirrors")
    assert full.mean == pytest.approx(61.0)
    assert full.std == pytest.approx(2 / 2**0.5)  # of 60 and 62, with n - 1
    assert full.seeds == 2
    average = cell(filled, 1, "avg")
    assert average.mean == pytest.approx(56.0)
    assert average.paper == 50.0
    assert pd.isna(average.difference)  # the scenes are not the paper's
    assert cell(filled, 1, "glassware", "psnr").mean == pytest.approx(30.51)


def test_the_papers_average_stands_only_where_an_order_can_be_compared(
    table: Table, tmp_path: Path
):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    filled = filled_of(table, tmp_path)
    assert [cell(filled, row, "avg").paper for row in (0, 1)] == [40.0, 50.0]
    assert pd.isna(cell(filled, 2, "avg").paper)  # alone in its group: the other row has no run
    assert pd.isna(cell(filled, 3, "avg").paper)
    assert pd.isna(cell(filled, 1, "glassware").paper)
    assert "In brackets: the paper's average, of its own scenes (lerf\\_ovs)." in to_latex(filled)


def test_a_missing_run_is_missing(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value, skip=[("Full", "mirrors", s) for s in (0, 1)])
    filled = filled_of(table, tmp_path)
    assert pd.isna(cell(filled, 1, "mirrors").mean)
    assert pd.isna(cell(filled, 1, "avg").mean)  # no average of half the scenes
    assert cell(filled, 1, "glassware").seeds == 2
    latex = to_latex(filled)
    assert re.search(r"Full .*--", latex)
    assert "Someone" in latex


def test_paper_values_and_differences_on_the_papers_scenes(table: Table, tmp_path: Path):
    ours = Table(
        **{**vars(table), "dataset": "synthetic", "scenes": {"g": "glassware", "m": "mirrors"}}
    )
    fake_runs(tmp_path, [ours], BENCHMARK, value)
    filled = filled_of(ours, tmp_path)
    assert filled.same_scenes
    assert cell(filled, 1, "avg").difference == pytest.approx(6.0)
    assert "(50.0, +6.0)" in to_latex(filled)
    assert "In brackets: the paper's value, and ours minus it." in to_latex(filled)


BY_CATEGORY = """
label: tiny
caption: words
dataset: lerf_ovs
scenes: {ramen: ramen}
metrics: [miou]
by: category
categories: {big_wall: other, cup: translucent_reflective}
rows:
  - {label: Without_it, set: [indicator=opacity], paper: {cup: 40.0}}
  - {label: Full, set: [], paper: {cup: 50.0}}
"""


def test_categories_of_several_scenes_by_kind(tmp_path: Path):
    path = tmp_path / "tiny.yaml"
    path.write_text(BY_CATEGORY)
    table = load_table(path)
    fake_runs(tmp_path, [table], BENCHMARK, value)
    filled = filled_of(table, tmp_path)
    lines = {line.label: line for line in arrange(filled).lines}
    assert [(line.group, line.label) for line in arrange(filled).lines] == [
        ("other", "glassware: big wall"),
        ("other", "mirrors: big wall"),
        ("other", "mean of other"),
        ("translucent_reflective", "glassware: cup"),
        ("translucent_reflective", "glassware: pot"),
        ("translucent_reflective", "mirrors: cup"),
        ("translucent_reflective", "mirrors: pot"),
        ("translucent_reflective", "mean of translucent_reflective"),
    ]  # a category that no view shows has no line
    without, full, less = lines["mean of translucent_reflective"].entries
    assert without.mean == pytest.approx(100 * (0.41 + 0.31 + 0.51 + 0.41) / 4)
    assert less.mean == pytest.approx(without.mean - full.mean) == pytest.approx(-10.0)
    assert arrange(filled).headers == (
        "Without_it (%)",
        "Full (%)",
        "Without_it minus Full (%)",
    )
    balanced(to_latex(filled))


def test_a_table_of_one_kind_shows_that_kind(tmp_path: Path):
    path = tmp_path / "tiny.yaml"
    path.write_text(BY_CATEGORY.replace("big_wall: other, ", ""))
    table = load_table(path)
    fake_runs(tmp_path, [table], BENCHMARK, value)
    assert {line.group for line in arrange(filled_of(table, tmp_path)).lines} == {
        "translucent_reflective"
    }


def test_the_papers_categories_are_found_with_blanks(tmp_path: Path):
    path = tmp_path / "tiny.yaml"
    text = BY_CATEGORY.replace("paper: {cup: 50.0}", "paper: {big_wall: 80.0}")
    path.write_text(
        text.replace("dataset: lerf_ovs", "dataset: synthetic").replace(
            "ramen: ramen", "g: glassware"
        )
    )
    one = Benchmark("synthetic", ("data=synthetic",), ("glassware",), (0,))
    table = load_table(path)
    fake_runs(tmp_path, [table], one, value)
    filled = filled_of(table, tmp_path, one)
    assert cell(filled, 1, "big wall").difference == pytest.approx(10.0)


def test_runs_that_must_not_stand_together_are_refused(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    runs = read_metrics(tmp_path)
    twins = f"must be one, got {tmp_path}/runs/{runs[0]['config_hash']}, twin of {tmp_path}/runs.csv, whose"
    with pytest.raises(ValueError, match=twins):
        require_one_meaning(tidy(to_lines([*runs, runs[0] | {"config_hash": "twin"}])), tmp_path)
    protocols = rf"must share a protocol, got dense@1/synthetic, dense@2 in {tmp_path}/runs/"
    with pytest.raises(ValueError, match=protocols):
        require_one_meaning(
            tidy(to_lines([*runs[1:], runs[0] | {"protocol": "dense@2"}])), tmp_path
        )
