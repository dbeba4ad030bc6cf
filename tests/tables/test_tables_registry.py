"""The registry says what the paper says, and only what the configuration knows."""

import csv
from pathlib import Path

import pytest
from slow import with_slow

from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import AVERAGE, Table, choose, load_table, load_tables

PRINTED = Path(__file__).parents[1] / "fixtures" / "paper_tables.csv"
"""Every number of the paper's tables, read off by hand."""

TABLES = load_tables()
PAPER_METRICS = {"fps": "fps_query", "miou_gain": None}


def runnable_rows() -> list[tuple[str, ...]]:
    return sorted(
        {
            row.overrides
            for table in TABLES.values()
            for row in table.rows
            if row.overrides is not None
        }
    )


def of_known_values() -> list[tuple[str, ...]]:
    """Rows all of whose values stand in rows before: other combinations of them."""
    known, found = set[str](), []
    for row in runnable_rows():
        if row and known.issuperset(row):
            found.append(row)
        known.update(row)
    return found


@pytest.mark.parametrize("overrides", with_slow(runnable_rows(), of_known_values()), ids=" ".join)
@pytest.mark.usefixtures("unchecked")
def test_every_row_is_a_configuration(overrides: tuple[str, ...]):
    budget = ("data=synthetic", "trainer=benchmark")
    benchmark = Benchmark("synthetic", budget, ("glassware",), (0,))
    full = Composer(benchmark).identity((), 0)
    found = Composer(benchmark).identity(overrides, 0)
    # What a benchmark says of the budget, a row may say again.
    assert (found == full) == (overrides in ((), ("trainer.iterations=400",)))


def test_every_number_of_the_paper_stands_in_the_registry():
    with PRINTED.open() as file:
        printed = list(csv.DictReader(file))
    want: dict[str, list[float]] = {}
    for line in printed:
        if PAPER_METRICS.get(line["metric"], "") is None:
            continue  # gains are the difference of two rows
        want.setdefault(line["table"].removeprefix("tab:"), []).append(float(line["value"]))
    for label, numbers in want.items():
        have = [
            v
            for row in TABLES[label].rows
            for values in row.paper.values()
            for v in values.values()
        ]
        assert sorted(have) == sorted(numbers), label


def test_numbers_of_the_paper_stand_where_it_has_them():
    with PRINTED.open() as file:
        printed = list(csv.DictReader(file))
    for line in printed:
        metric = PAPER_METRICS.get(line["metric"], line["metric"])
        if metric is None:
            continue
        table = TABLES[line["table"].removeprefix("tab:")]
        column = line["category"] or line["scene"]
        rows = [row for row in table.rows if row.group[:1] == line["group"]]
        assert any(row.paper.get(column, {}).get(metric) == float(line["value"]) for row in rows), (
            line
        )
        assert column == AVERAGE or column in (table.kinds if table.by_category else table.scenes)


def test_averages_are_those_of_the_scenes_but_for_the_papers_own_slips():
    slips = []
    for table in TABLES.values():
        for row in table.rows:
            scenes = {c: v for c, v in row.paper.items() if c != AVERAGE}
            for metric, average in row.paper.get(AVERAGE, {}).items():
                mean = sum(values[metric] for values in scenes.values()) / len(scenes)
                digits = 2 if metric == "ssim" else 1
                if abs(mean - average) > 0.5 * 10**-digits + 1e-9:
                    slips.append((table.label, row.label))
    # 12 averages of the paper do not agree with its own scenes.
    assert len(slips) == 12, slips


def test_a_table_of_ones_own_is_a_file(tmp_path: Path):
    text = "label: mine\ncaption: c\ndataset: synthetic\nmetrics: [miou]\nrows: [{label: Full, set: []}]\n"
    mine = tmp_path / "mine.yaml"
    mine.write_text(text)
    assert [t.label for t in choose([str(mine), "value"], TABLES)] == ["mine", "value"]
    ours = tmp_path / "value.yaml"
    ours.write_text(text.replace("mine", "value"))
    with pytest.raises(ValueError, match="must have a label of its own, got that of ours"):
        choose([str(ours)], TABLES)
    with pytest.raises(OSError, match="nowhere"):
        choose([str(tmp_path / "nowhere.yaml")], TABLES)


def test_tables_are_found_with_and_without_prefix():
    assert [t.label for t in choose(["tab:ab-cam", "value", "ab-cam"], TABLES)] == [
        "ab-cam",
        "value",
    ]
    assert len(choose(["all"], TABLES)) == len(TABLES)
    with pytest.raises(ValueError, match=r"tab: must be all, one of .*ab-cam.*got ab-cma"):
        choose(["ab-cma"], TABLES)


GOOD = """
label: tiny
caption: words
dataset: lerf_ovs
scenes: {ramen: ramen}
metrics: [miou]
rows:
  - {label: full, set: [], paper: {ramen: 1.5}}
"""


def read(tmp_path: Path, text: str) -> Table:
    path = tmp_path / "tiny.yaml"
    path.write_text(text)
    return load_table(path)


def test_a_table_is_read(tmp_path: Path):
    table = read(tmp_path, GOOD)
    assert table.rows[0].overrides == ()
    assert table.rows[0].paper == {"ramen": {"miou": 1.5}}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("caption: words", "captoin: words", "must have caption"),
        ("dataset: lerf_ovs", "dataset: lerf_ovs\nbye: scene", "must have no key but .* got 'bye'"),
        ("label: tiny", "label: other", "label must be the file's name tiny, got other"),
        (
            "caption: words",
            "caption: words\nnumber: four",
            "number must be a whole number from 1, got 'four'",
        ),
        ("[miou]", "[moiu]", "metrics must be of .*, got 'moiu'"),
        ("set: []", "set: fusion=none", "rows\\[0\\]: set must be a list"),
        ("set: []", "group: A", "rows\\[0\\]: must have set, got keys"),
        ("ramen: 1.5", "raman: 1.5", "paper must have columns of avg, ramen, got 'raman'"),
        ("ramen: 1.5", "ramen: high", "paper must give numbers for miou, got miou: 'high'"),
        ("metrics: [miou]", "metrics: [miou", "must be YAML"),
    ],
)
def test_a_slip_in_a_table_is_named(tmp_path: Path, old: str, new: str, message: str):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, GOOD.replace(old, new))


def test_a_row_that_names_no_option_is_refused():
    composer = Composer(Benchmark("b", ("data=synthetic",), ("glassware",), (0,)))
    with pytest.raises(ValueError, match=r"fusion=sel"):
        composer.identity(["fusion=sel"], 0)
    with pytest.raises(ValueError, match=r"blend\.alhpa"):
        composer.identity(["blend.alhpa=1"], 0)


def test_quantities_are_entries_of_metrics_json():
    from vlgs.report.results import METRICS

    kinds = {f"miou_{kind}" for kind in ("translucent_reflective", "other")}
    assert {q.entry for q in QUANTITIES.values()} <= set(METRICS) | kinds


def test_the_table_of_skips_has_every_switch():
    from vlgs.skips import SKIPS

    rows = {row.overrides for row in TABLES["skips"].rows}
    assert rows == {()} | {(s.override(on=s.default == "off"),) for s in SKIPS if s.switchable}


def test_tables_that_refer_to_others_have_no_row_that_those_lack():
    """Of the paper's rows: what is run for a view or a twin is run for the other table too."""
    for table in TABLES.values():
        other = TABLES.get(table.same_runs_as or table.elsewhere, table)
        rows = {row.overrides for row in table.rows}
        assert rows <= {row.overrides for row in other.rows}, table.label
        assert other.label == (table.same_runs_as or table.elsewhere or table.label)
