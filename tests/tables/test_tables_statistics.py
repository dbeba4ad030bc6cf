"""Intervals and agreement against cases worked by hand, Monte Carlo and scipy."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from tables_fakes import fake_runs

from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.fill import Filled, fill
from vlgs.tables.frame import read_metrics, tidy, to_lines
from vlgs.tables.registry import Row, load_table
from vlgs.tables.statistics import (
    bootstrap_interval,
    judge,
    kendall_tau,
    order_agreement,
    paired_differences,
    sentence,
)


def scipys_tau(ours: Sequence[float], papers: Sequence[float]) -> float:
    return float(np.asarray(stats.kendalltau(ours, papers))[0])


def test_an_interval_worked_by_hand():
    """Two scenes with one seed each: a resample is their mean or one of them, with chances 1/2, 1/4, 1/4."""
    assert bootstrap_interval([np.array([1.0]), np.array([3.0])], seed=0) == (1.0, 3.0)


def test_one_scene_is_the_bootstrap_over_its_seeds():
    """Five seeds of 0, 0, 0, 0, 1: the mean of a resample is binomial(5, 1/5) / 5, whose quantiles are known."""
    low, high = bootstrap_interval([np.array([0.0, 0.0, 0.0, 0.0, 1.0])], seed=0)
    want = stats.binom(5, 0.2).ppf([0.025, 0.975]) / 5
    assert (low, high) == pytest.approx(tuple(want))


def test_equal_numbers_have_no_width():
    part = np.array([0.7, 0.7, 0.7])
    assert bootstrap_interval([part, part], seed=3) == pytest.approx((0.7, 0.7))


def test_scenes_of_unequal_size_against_a_plain_loop():
    rng = np.random.default_rng(5)
    scenes = [rng.normal(0, 1, 3), rng.normal(2, 1, 5), rng.normal(-1, 2, 4), rng.normal(1, 1, 1)]
    means = []
    for _ in range(20_000):
        drawn = [scenes[i] for i in rng.integers(len(scenes), size=len(scenes))]
        means.append(np.mean([rng.choice(part, size=len(part)).mean() for part in drawn]))
    got = bootstrap_interval(scenes, seed=0)
    # Both are Monte Carlo: quantiles of 10 000 and 20 000 draws of width 1 differ by about 0.03 (3 sigma measured over seeds: 0.07).
    assert got == pytest.approx(tuple(np.quantile(means, [0.025, 0.975])), abs=0.1)


def test_many_scenes_cover_the_truth_as_often_as_promised():
    """Normal scene effects and seeds around a known mean; the percentile interval of 12 scenes covers a little less than 95%."""
    rng = np.random.default_rng(1)
    covered = 0
    for trial in range(150):
        effects = rng.normal(0.5, 1.0, 12)
        low, high = bootstrap_interval([rng.normal(e, 0.3, 3) for e in effects], seed=trial)
        covered += low <= 0.5 <= high
    # Binomial(150, 0.92): 3 sigma is 10 below 138; all of them would mean an interval that is too wide.
    assert 125 <= covered < 150


def test_one_number_says_nothing():
    assert bootstrap_interval([np.array([5.0])], seed=0) == (-math.inf, math.inf)


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=2, max_size=9))
def test_kendall_is_scipys(pairs: list[tuple[int, int]]):
    ours, papers = [float(a) for a, _ in pairs], [float(b) for _, b in pairs]
    want = scipys_tau(ours, papers)
    assert kendall_tau(ours, papers) == pytest.approx(want, nan_ok=True)


def test_kendall_needs_two():
    assert math.isnan(kendall_tau([1.0], [2.0]))
    assert math.isnan(kendall_tau([], []))


@pytest.mark.parametrize(
    ("low", "high", "paper", "verdict"),
    [
        (-3.0, -1.0, -2.0, "holds"),
        (1.0, 3.0, -2.0, "reversed"),
        (-1.0, 1.0, -2.0, "undecided"),
        (-math.inf, math.inf, -2.0, "undecided"),
        (-3.0, -1.0, math.nan, "no claim"),
        (-3.0, -1.0, 0.0, "no claim"),
    ],
)
def test_verdicts(low: float, high: float, paper: float, verdict: str):
    assert judge(low, high, paper) == verdict


TABLE = """
label: tiny
caption: words
dataset: lerf_ovs
scenes: {ramen: ramen}
metrics: [miou]
rows:
  - {label: Worse, set: [fusion=none], paper: {avg: 40.0}}
  - {label: Full, set: [], paper: {avg: 50.0}}
  - {label: Better, set: [indicator=opacity], paper: {avg: 45.0}}
  - {label: Same, set: [fusion=mlp], paper: {avg: 48.0}}
  - {label: Ours, set: [fusion=cross]}
  - {label: Full again, set: [], paper: {avg: 50.0}}
"""
BENCHMARK = Benchmark("synthetic", ("data=synthetic",), ("glassware", "mirrors"), (0, 1, 2))


def value(row: Row, scene: str, seed: int) -> float:
    """Scenes and seeds differ widely, so that only pairs show a difference."""
    offset = {"Worse": -0.05, "Better": 0.04, "Same": 0.03 * (-1) ** seed, "Ours": 0.02}
    offset |= {"Clean full": 0.1}
    return 0.5 + (0.2 if scene == "mirrors" else 0.0) + 0.05 * seed + offset.get(row.label, 0.0)


def filled_of(
    tmp_path: Path,
    benchmark: Benchmark = BENCHMARK,
    skip: list[tuple[str, str, int]] | None = None,
    text: str = TABLE,
) -> Filled:
    path = tmp_path / "tiny.yaml"
    path.write_text(text)
    table = load_table(path)
    fake_runs(tmp_path, [table], benchmark, value, skip=skip or [])
    return fill(table, benchmark, Composer(benchmark), tidy(to_lines(read_metrics(tmp_path))))


def test_rows_are_judged_in_pairs(tmp_path: Path):
    filled = filled_of(tmp_path)
    found = {d.label: d for d in paired_differences(filled, "miou")}
    assert {name: d.verdict for name, d in found.items()} == {
        "Worse": "holds", "Better": "reversed", "Same": "undecided", "Ours": "no claim",
    }  # fmt: skip
    assert found["Worse"].mean == pytest.approx(-5.0)
    assert (found["Worse"].low, found["Worse"].high) == pytest.approx((-5.0, -5.0))
    assert found["Worse"].pairs == 6
    assert found["Worse"].paper == pytest.approx(-10.0)
    text = sentence(filled, "miou")
    assert "The paper's sign holds for Worse -5.0 [-5.0, -5.0] (paper -10.0)." in text
    assert "It is reversed for Better +4.0" in text
    assert "The data cannot tell for Same +1.0" in text
    assert "The paper gives no number for Ours +2.0" in text
    # Ours: Worse < Full < Same < Better; the paper: Worse < Better < Same < Full. rows of the full model count once.
    want = scipys_tau([55, 60, 64, 61], [40, 50, 45, 48])
    assert order_agreement(filled, "miou") == pytest.approx(want)
    assert f"{want:+.2f}" in text


def test_the_order_in_which_runs_are_read_moves_no_interval(tmp_path: Path):
    rng = np.random.default_rng(0)
    filled = filled_of(tmp_path)
    spread = [n._replace(value=n.value + rng.normal()) for n in filled.numbers]
    one, other = (
        paired_differences(replace(filled, numbers=numbers), "miou")
        for numbers in (spread, spread[::-1])
    )
    assert [(d.low, d.high) for d in other] == [(d.low, d.high) for d in one]


def test_a_group_on_other_data_is_compared_with_its_own_full_model(tmp_path: Path):
    other = "data.faults.noise=0"
    more = f"""
  - {{label: Worse, group: Clean, set: [fusion=none, {other}]}}
  - {{label: Clean full, group: Clean, set: [{other}]}}
"""
    filled = filled_of(tmp_path, text=TABLE + more.lstrip("\n"))
    differences = paired_differences(filled, "miou")
    assert [(d.group, d.mean) for d in differences if d.label == "Worse"] == [
        ("", pytest.approx(-5.0)),
        ("Clean", pytest.approx(-15.0)),
    ]
    assert "Clean full" not in {d.label for d in differences}


def test_pairs_without_a_partner_are_left_out(tmp_path: Path):
    skip = [
        ("Worse", "mirrors", 0),
        ("Worse", "mirrors", 1),
        ("Worse", "mirrors", 2),
        ("Worse", "glassware", 1),
    ]
    filled = filled_of(tmp_path, skip=skip)
    worse = next(d for d in paired_differences(filled, "miou") if d.label == "Worse")
    assert worse.pairs == 2
    assert worse.mean == pytest.approx(-5.0)  # and not the difference of unequal scenes


def test_without_the_full_model_nothing_is_said(tmp_path: Path):
    skip = [
        (name, scene, seed)
        for name in ("Full", "Full again")
        for scene in BENCHMARK.scenes
        for seed in (0, 1, 2)
    ]
    filled = filled_of(tmp_path, skip=skip)
    assert paired_differences(filled, "miou") == []
    assert sentence(filled, "miou").startswith("No row can be compared")


def test_one_run_of_each_has_a_difference_but_no_verdict(tmp_path: Path):
    filled = filled_of(tmp_path, Benchmark("synthetic", ("data=synthetic",), ("glassware",), (0,)))
    assert {d.verdict for d in paired_differences(filled, "miou")} == {"undecided", "no claim"}
    assert "Worse -5.0 [one pair, no interval] (paper -10.0)" in sentence(filled, "miou")
