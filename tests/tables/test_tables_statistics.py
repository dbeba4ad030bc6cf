"""Which rows are compared with which, and what may be claimed of them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from tables_fakes import fake_runs

from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.fill import Filled, fill
from vlgs.tables.frame import read_metrics, tidy, to_lines
from vlgs.tables.markdown import to_markdown
from vlgs.tables.registry import Row, load_table
from vlgs.tables.said import claims_csv, say
from vlgs.tables.statistics import Claim, claims, judge, orders


def scipys_tau(ours: Sequence[float], papers: Sequence[float]) -> float:
    return float(np.asarray(stats.kendalltau(ours, papers))[0])


@pytest.mark.parametrize(
    ("p", "mean", "within", "paper", "verdict"),
    [
        (0.01, -3.0, False, -2.0, "holds"),
        (0.01, 3.0, False, -2.0, "reversed"),
        (0.01, 0.5, True, -2.0, "reversed"),
        (0.06, 3.0, False, -2.0, "cannot be told"),
        (0.06, 0.1, True, -2.0, "equivalent"),
        (0.01, -3.0, False, math.nan, "below"),
        (0.01, 3.0, False, 0.0, "above"),
    ],
)
def test_verdicts(p: float, mean: float, within: bool, paper: float, verdict: str):
    assert judge(p, mean, within, paper) == verdict


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
  - {label: Alike, set: [blend=none], paper: {avg: 47.0}}
  - {label: Ours, set: [fusion=cross]}
  - {label: Full again, set: [], paper: {avg: 50.0}}
"""
BENCHMARK = Benchmark("synthetic", ("data=synthetic",), ("glassware", "mirrors"), (0, 1, 2))


def value(row: Row, scene: str, seed: int) -> float:
    """Scenes and seeds differ widely, so that only pairs show a difference."""
    offset = {"Worse": -0.05, "Better": 0.04, "Same": 0.03 * (-1) ** seed, "Ours": 0.02}
    offset |= {"Clean full": 0.1, "Alike": 0.001 * (-1) ** seed}
    offset |= {"Four seeds": 0.01, "bare": 0.03, "a alone": 0.01, "b alone": 0.02}
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


def by_label(filled: Filled) -> dict[str, Claim]:
    return {claim.label: claim for claim in claims(filled)}


def test_rows_are_judged_in_pairs(tmp_path: Path):
    filled = filled_of(tmp_path)
    found = by_label(filled)
    assert {name: d.verdict for name, d in found.items()} == {
        "Worse": "holds", "Better": "reversed", "Same": "cannot be told", "Alike": "equivalent", "Ours": "above",
    }  # fmt: skip
    worse = found["Worse"]
    assert worse.mean == pytest.approx(-5.0)
    assert worse.here
    assert (worse.here.low, worse.here.high) == pytest.approx((-5.0, -5.0))
    assert (worse.scenes, worse.agree, worse.seeds) == (2, 2, 3)
    assert worse.paper == pytest.approx(-10.0)
    assert worse.beyond is None  # two scenes are no sample of scenes
    # Seeds lie 5 points apart and Better 4 points above: it beats the same seed and those below, on each scene.
    assert found["Better"].better == pytest.approx(6 / 9)
    same = [3.0, -3.0, 3.0]  # on both scenes, hence the same mean with half of the variance
    assert found["Same"].here
    error = np.std(same, ddof=1) / 3**0.5 / 2**0.5
    want = stats.t.interval(0.95, 4, 1.0, error)
    assert (found["Same"].here.low, found["Same"].here.high) == pytest.approx(want)
    # Holm: the largest of five p-values stays.
    assert max(c.here.p for c in found.values() if c.here) == pytest.approx(found["Alike"].here.p)  # pyright: ignore[reportOptionalMemberAccess]


def test_what_is_said_is_in_all_formats(tmp_path: Path):
    filled = filled_of(tmp_path)
    said = say(filled)
    lines = {line[0]: line for line in said.lines}
    assert lines["Worse"][1:4] == ("mIoU (%)", "-5.00", "-5.00 to -5.00")
    assert lines["Worse"][-1] == "holds"
    assert "over all 5 differences" in said.before
    # Ours: Worse < Full < Alike < Same < Better; the paper: Worse < Better < Alike < Same < Full. Rows of the full model count once.
    want = scipys_tau([55, 60, 64, 61, 60.033], [40, 50, 45, 48, 47])
    (order,) = orders(filled)
    assert order.tau == pytest.approx(want)
    assert order.rows == 5
    assert f"{want:+.2f} (5 rows)" in said.after
    text = to_markdown(filled)
    assert "-5.00 to -5.00" in text
    assert f"{want:+.2f} (5 rows)" in text
    assert ",Worse,miou,-5.0000,-5.0000,-5.0000," in (claims_csv(filled) or "")


@pytest.mark.parametrize("seeds", [1, 2])
def test_a_claim_on_few_seeds_is_refused(tmp_path: Path, seeds: int):
    few = replace(BENCHMARK, seeds=tuple(range(seeds)))
    filled = filled_of(tmp_path, few)
    assert {claim.verdict for claim in claims(filled)} == {"no claim"}
    said = say(filled)
    assert said.lines == ()
    assert said.before.startswith(f"No claim is made: rows have {seeds} seed")
    assert claims_csv(filled) is None


def test_a_table_of_one_seed_is_made_of_that_seed(tmp_path: Path):
    filled = filled_of(tmp_path, text=TABLE.replace("metrics:", "seeds: [1]\nmetrics:"))
    assert {cell.seeds for cell in filled.cells.values()} == {1}
    assert "One seed, hence no deviation and no claim." in to_markdown(filled)
    assert "**" not in to_markdown(filled)
    assert {claim.verdict for claim in claims(filled)} == {"no claim"}


def test_five_scenes_speak_of_scenes_like_these(tmp_path: Path):
    names = ("glassware", "mirrors", "lookalikes", "patchwork", "another")
    filled = filled_of(tmp_path, replace(BENCHMARK, scenes=names))
    shift: dict[str, float] = dict(zip(names, (0.0, 3.0, -3.0, 6.0, -6.0), strict=True))
    numbers = [
        n._replace(value=n.value + shift.get(n.column, 0.0) * (filled.table.rows[n.row].label == "Better"))
        for n in filled.numbers
    ]  # fmt: skip
    better = by_label(replace(filled, numbers=numbers))["Better"]
    assert better.here
    assert better.beyond
    want = stats.t.interval(0.95, 4, 4.0, np.std(list(shift.values()), ddof=1) / 5**0.5)
    assert (better.beyond.low, better.beyond.high) == pytest.approx(want)
    assert (better.here.verdict, better.beyond.verdict) == ("reversed", "cannot be told")
    assert (better.agree, better.scenes) == (4, 5)
    said = say(replace(filled, numbers=numbers))
    (line,) = (line for line in said.lines if line[0] == "Better")
    assert line[-1] == "reversed; on scenes like these cannot be told"


SWITCHES = """
label: tiny
caption: words
dataset: lerf_ovs
scenes: {ramen: ramen}
metrics: [miou, train_minutes]
rows:
  - {label: bare, marks: {a: false, b: false}, set: [fusion=none, blend=none], paper: {avg: 40.0}}
  - {label: a alone, marks: {a: true, b: false}, set: [blend=none], paper: {avg: 44.0}}
  - {label: b alone, marks: {a: false, b: true}, set: [fusion=none], paper: {avg: 42.0}}
  - {label: both, marks: {a: true, b: true}, set: [], paper: {avg: 50.0}}
"""


def test_effects_of_switches_worked_by_hand(tmp_path: Path):
    """Rows are 3, 1, 2 and 0 points above the full model, whatever the seed; times make no claim."""
    filled = filled_of(tmp_path, text=SWITCHES)
    assert {claim.metric for claim in claims(filled)} == {"miou"}
    found = {c.label: c for c in claims(filled) if c.effect}
    assert {name: round(c.mean, 6) for name, c in found.items()} == {"a": -2.0, "b": -1.0, "a x b": 0.0}  # fmt: skip
    assert {name: c.paper for name, c in found.items()} == {"a": 6.0, "b": 4.0, "a x b": 2.0}
    assert found["a"].verdict == found["b"].verdict == "reversed"
    assert len(claims(filled)) == 6  # three rows against the full one, and three effects
    without_one = filled_of(tmp_path, text=SWITCHES.replace("  - {label: b alone", "  # - {"))
    assert not any(claim.effect for claim in claims(without_one))


def test_orders_are_compared_within_groups(tmp_path: Path):
    text = TABLE.replace("label: Worse,", "label: Worse, group: B,").replace(
        "label: Same,", "label: Same, group: B,"
    )
    found = {order.group: order for order in orders(filled_of(tmp_path, text=text))}
    assert found["B"].tau == 1.0
    assert found["B"].rows == 2
    assert found[""].tau == pytest.approx(scipys_tau([60, 64, 60.033], [50, 45, 47]))


def test_the_order_in_which_runs_are_read_moves_no_interval(tmp_path: Path):
    rng = np.random.default_rng(0)
    filled = filled_of(tmp_path)
    spread = [n._replace(value=n.value + rng.normal()) for n in filled.numbers]
    one, other = (claims(replace(filled, numbers=n)) for n in (spread, spread[::-1]))
    assert [claim.here for claim in other] == [claim.here for claim in one]


@pytest.mark.parametrize("other", ["data.faults.noise=0", "trainer.iterations=2500"])
def test_a_group_on_other_data_or_budget_is_compared_with_its_own_full_model(
    tmp_path: Path, other: str
):
    more = f"""
  - {{label: Worse, group: Clean, set: [fusion=none, {other}]}}
  - {{label: Clean full, group: Clean, set: [{other}]}}
"""
    filled = filled_of(tmp_path, text=TABLE + more.lstrip("\n"))
    differences = claims(filled)
    assert [(d.group, d.mean) for d in differences if d.label == "Worse"] == [
        ("", pytest.approx(-5.0)),
        ("Clean", pytest.approx(-15.0)),
    ]
    assert "Clean full" not in {d.label for d in differences}


def test_a_table_can_name_the_row_that_others_are_compared_with(tmp_path: Path):
    more = """
  - {label: Worse, group: Clean, set: [fusion=none, data.faults.noise=0]}
  - {label: Better, group: Clean, set: [blend=none, data.faults.noise=0]}
"""
    text = TABLE.replace("rows:", "against: Better\nrows:") + more.lstrip("\n")
    filled = filled_of(tmp_path, text=text)
    found = {(claim.group, claim.label): claim.mean for claim in claims(filled)}
    assert ("", "Better") not in found
    assert ("Clean", "Better") not in found
    assert found["", "Worse"] == found["Clean", "Worse"] == pytest.approx(-9.0)
    assert found["", "Full"] == pytest.approx(-4.0)
    assert "row minus 'Better'" in say(filled).before
    with pytest.raises(ValueError, match="against must be a row's label"):
        filled_of(tmp_path, text=text.replace("against: Better", "against: Bettr"))


def test_pairs_without_a_partner_are_left_out(tmp_path: Path):
    skip = [
        ("Worse", "mirrors", 0),
        ("Worse", "mirrors", 1),
        ("Worse", "mirrors", 2),
        ("Worse", "glassware", 1),
    ]
    filled = filled_of(tmp_path, skip=skip)
    worse = by_label(filled)["Worse"]
    assert (worse.scenes, worse.seeds, worse.verdict) == (1, 2, "no claim")
    assert worse.mean == pytest.approx(-5.0)  # and not the difference of unequal scenes


def test_without_the_full_model_nothing_is_said(tmp_path: Path):
    skip = [
        (name, scene, seed)
        for name in ("Full", "Full again")
        for scene in BENCHMARK.scenes
        for seed in (0, 1, 2)
    ]
    filled = filled_of(tmp_path, skip=skip)
    assert claims(filled) == []
    assert say(filled).before.startswith("No row can be compared")
