"""Runs of committed tables, trained again: what must be the same is, and what is not is told."""

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.tables.tables_fakes import BENCHMARK, fake_runs
from vlgs.bench import repeat
from vlgs.bench.__main__ import main
from vlgs.bench.record import read_record
from vlgs.bench.repeat import Recorded, choose_runs, numbers_of
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.registry import load_tables
from vlgs.tables.write import write_all

Change = Callable[[dict[str, Any]], None]
TINY = (
    "data=synthetic", "data.width=48", "data.height=36", "data.train_views=4", "data.test_views=1", "data.points=300",
    "trainer=smoke", "trainer.iterations=3", "head.training.steps=5",
)  # fmt: skip


@pytest.fixture
def committed(tmp_path: Path) -> Path:
    """Results as a clone has them: tables and runs.csv, no run."""
    results = tmp_path / "results"
    tables = [load_tables()[name] for name in ("convention", "prune-on")]
    machine = {"machine": {"cpu": "a cpu", "isa": "v3", "threads": 1}}
    fake_runs(results, tables, BENCHMARK, lambda row, scene, seed: 0.5 + 0.01 * seed, more=machine)
    BENCHMARK.extend(results / "synthetic" / "benchmark.yaml")
    write_all(results, tables)
    shutil.move(results / "runs", tmp_path / "trained")
    return results


def trained_again(committed: Path, monkeypatch: pytest.MonkeyPatch, change: Change) -> list[str]:
    """Put what was trained in the place of a training; returns the commands."""
    commands: list[str] = []

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        commands.append(" ".join(command))
        chosen = next(
            one
            for one in choose_runs(committed, (), (), 0)
            if " ".join(one.command) in commands[-1]
        )
        metrics = json.loads(
            (committed.parent / "trained" / chosen.run / "metrics.json").read_text()
        )
        change(metrics)
        folder = Path(command[-1].removeprefix("results=")) / "runs" / chosen.run
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps(metrics))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(repeat, "subprocess", SimpleNamespace(run=run))
    return commands


def repeated(committed: Path) -> tuple[int, Any]:
    out = committed.parent / "out"
    status = main(["repeat", "--results", str(committed), "--out", str(out)])
    return status, read_record(out / "repeat.csv")


def test_the_same_numbers_hold_whatever_time_they_took(
    committed: Path, monkeypatch: pytest.MonkeyPatch
):
    commands = trained_again(committed, monkeypatch, lambda m: m.update(train_seconds=1e9))
    status, table = repeated(committed)
    assert status == 0
    assert list(table.table) == ["convention", "prune-on"]
    assert len(set(table.run)) == 2
    assert (table.differing == 0).all()
    assert (table.numbers >= 9).all()
    assert all("threads=1" in each and "pictures=false" in each for each in commands)


@pytest.mark.parametrize("name", ["miou", "per_category", "config_hash", "missing"])
def test_what_differs_is_told_and_is_status_1(
    name: str, committed: Path, monkeypatch: pytest.MonkeyPatch
):
    def change(metrics: dict[str, Any]) -> None:
        if name == "per_category":
            metrics[name]["cup"] += 1e-9
        elif name == "missing":
            del metrics["ssim"]
        else:
            metrics[name] = metrics[name] + 1e-12 if name == "miou" else "another"

    trained_again(committed, monkeypatch, change)
    status, table = repeated(committed)
    assert status == 1
    assert (table.differing == (0 if name == "config_hash" else 1)).all()
    assert (table.same_id == (name != "config_hash")).all()


@pytest.mark.parametrize("what", ["cpu", "isa"])
def test_another_machine_may_differ(what: str, committed: Path, monkeypatch: pytest.MonkeyPatch):
    def change(metrics: dict[str, Any]) -> None:
        metrics["miou"] *= 1.01
        metrics["machine"][what] = "another"

    trained_again(committed, monkeypatch, change)
    status, table = repeated(committed)
    assert status == 0
    assert (table.differing == 1).all()
    assert table.largest.tolist() == pytest.approx([0.01 / 1.01] * 2, rel=1e-4)
    assert not table.same_machine.any()


def test_another_seed_chooses_others(committed: Path):
    found = [tuple(one.run for one in choose_runs(committed, (), (), s)) for s in range(8)]
    assert found[0] == tuple(one.run for one in choose_runs(committed, (), (), 0))
    assert len(set(found)) > 1


def test_bad_input_is_one_line(
    committed: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    out = ["--out", str(committed.parent)]
    for wrong, said in (
        (["--results", str(committed.parent)], "must hold runs.csv and tables of results version"),
        (["--results", str(committed), "--tables", "soup"], "tables must be of ab-cam"),
    ):
        assert main(["repeat", *wrong, *out]) == 1
        assert said in capsys.readouterr().err
    failed = subprocess.CompletedProcess([], 1, "", "a traceback\nerror: no such key\n")
    monkeypatch.setattr(repeat, "subprocess", SimpleNamespace(run=lambda *_, **__: failed))
    assert main(["repeat", "--results", str(committed), *out]) == 1
    assert capsys.readouterr().err.strip().endswith("must run, got: error: no such key")


def test_photographs_are_left_out_without_their_folder(
    committed: Path, capsys: pytest.CaptureFixture[str]
):
    before = len(choose_runs(committed, (), (), 0))
    street = Benchmark("street", ("data=colmap",), ("street",), (0,))
    street.extend(committed / "street" / "benchmark.yaml")
    assert len(choose_runs(committed, (), (), 0)) == before
    assert "street is left out: --override says where" in capsys.readouterr().out


def test_photographs_are_found_where_they_are_said_to_be(committed: Path):
    table, street = load_tables()["convention"], ("data=colmap", "data.resize=0.5")
    here = ("data.root=photographs/street", "data.features=maps")
    benchmark = Benchmark("street", (*street, *here), ("street",), (0,))
    shutil.move(committed.parent / "trained", committed / "runs")
    fake_runs(committed, [table], benchmark, lambda *_: 0.5, more={"dataset": "colmap"})
    benchmark.extend(committed / "street" / "benchmark.yaml")
    write_all(committed, [table])
    moved = ("data.root=elsewhere/street", "data.features=maps")
    (one,) = (r for r in choose_runs(committed, (), moved, 0) if r.benchmark == "street")
    assert one.command[:4] == (*street, *moved)
    assert one.scene == "street"
    assert not any(word.startswith("data.scene") for word in one.command)


@pytest.mark.slow
def test_a_run_that_is_trained_again_has_the_same_numbers(tmp_path: Path):
    results, table = tmp_path / "results", load_tables()["convention"]
    benchmark = Benchmark("tiny", TINY, ("glassware",), (0,))
    row, scratch = table.rows[0], tmp_path / "scratch"
    who = Composer(benchmark).identity(row.overrides, 0)
    command = (*TINY, *row.overrides, "data.scene=glassware", "seed=0", "threads=1")
    one = Recorded(
        "tiny", "convention", row.label, "glassware", 0, "", None, None, None, command, {}
    )
    lines = repeat._train(one, scratch)
    assert (lines[0].recipe, lines[0].data_recipe) == (who.recipe, who.data)
    again = repeat.compare(
        replace(
            one,
            run=lines[0].config_hash,
            cpu=lines[0].cpu,
            isa=lines[0].isa,
            numbers=numbers_of(lines),
        ),
        repeat._train(one, scratch),
    )
    assert again.holds
    assert again.numbers > 20
    assert not results.exists()
