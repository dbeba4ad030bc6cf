"""One line per run: of any folder, and at the end of a multirun."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from tables_fakes import fake_runs
from tiny_runs import TINY

from vlgs.tables import __main__ as command
from vlgs.tables.benchmark import Benchmark
from vlgs.tables.registry import Row, Table
from vlgs.tables.runs import compare, read_runs

BENCHMARK = Benchmark("synthetic", ("data=synthetic",), ("glassware",), (0, 1))
TABLE = Table(
    "tiny", "words", "synthetic", {}, ("miou",), (Row("Without", ("fusion=none",)), Row("Full", ()))
)


def value(row: Row, scene: str, seed: int) -> float:
    return {"Without": 0.4, "Full": 0.5}[row.label] + 0.01 * seed


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two recipes with two seeds, configurations beside them."""
    fake_runs(tmp_path, [TABLE], BENCHMARK, value)
    for run in sorted(tmp_path.glob("runs/*")):
        metrics = (run / "metrics.json").read_text()
        full = '"miou": 0.5' in metrics
        target = "attention.SelfAttention" if full else "none.NoFusion"
        fusion = {"_target_": f"vlgs.fusion.{target}", **({"width": 4} if full else {})}
        seed = int('"seed": 1' in metrics)
        config = {"fusion": fusion, "seed": seed, "results": str(run), "data": {"root": str(run)}}
        (run / "config.yaml").write_text(yaml.safe_dump(config))
    return tmp_path


@pytest.mark.parametrize("inside", ["", "runs"])
def test_any_folder_of_runs_is_compared(
    results: Path, inside: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    out = results / "table.csv"
    monkeypatch.setattr(sys, "argv", ["tables", str(results / inside), f"write={out}"])
    command.main()
    head, *lines = capsys.readouterr().out.splitlines()
    words = head.split()
    assert words[:2] == ["fusion", "seed"]  # what differs, by the name of the option, and no place
    assert {tuple(line.split()[:2]) for line in lines} == {
        (fusion, seed) for fusion in ("none", "self") for seed in "01"
    }
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["fusion"], row["mIoU %"]) for row in rows} >= {("none", "41.0"), ("self", "50.0")}
    assert all(Path(row["run"]).is_dir() for row in rows)


def test_a_table_for_papers_and_stages_in_a_word(results: Path, tmp_path: Path):
    run = sorted(results.glob("runs/*"))[0]
    config = yaml.safe_load((run / "config.yaml").read_text())
    stages = [{"_target_": "a.TrainColor", "name": "geometry"}, {"_target_": "a.Lift"}]
    (run / "config.yaml").write_text(yaml.safe_dump(config | {"stages": stages}))
    table = compare(read_runs(results))
    assert "TrainColor+Lift" in {row[table.head.index("stages")] for row in table.rows}
    table.write(tmp_path / "t.tex")
    lines = (tmp_path / "t.tex").read_text().splitlines()
    assert lines[0].startswith(r"\begin{tabular}{l")
    assert {line.count("&") for line in lines if line.endswith(r"\\")} == {len(table.head) - 1}
    assert r"mIoU \%" in lines[2]


def test_a_name_that_no_table_has_is_refused_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys, "argv", ["tables", str(tmp_path), "write=mytab"])
    with pytest.raises(SystemExit, match=r"write must end in \.csv, \.md or \.tex, got mytab"):
        command.main()


def test_a_damaged_run_is_left_out_and_a_folder_without_runs_refused(
    results: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    damaged, odd = sorted(results.glob("runs/*"))[:2]
    (damaged / "metrics.json").write_text("{}")
    (odd / "config.yaml").write_text("{")
    assert len(compare(read_runs(results)).rows) == 3
    assert str(damaged / "metrics.json") in caplog.text
    assert str(odd / "config.yaml") in caplog.text
    with pytest.raises(ValueError, match=r"must hold finished runs .*, got none"):
        read_runs(tmp_path / "nowhere")


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["basic", "processes"])
def test_a_multirun_ends_with_a_table_of_its_runs(tmp_path: Path, launcher: str):
    if launcher == "processes":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    run = [sys.executable, "-m", "vlgs.run"]
    short = [*TINY, "trainer=smoke", "trainer.iterations=2", "pictures=false", "threads=1"]
    short += [f"results={tmp_path}", "sharing=none"]
    several = ["-m", "fusion=none,self", f"hydra/launcher={launcher}"]
    done = subprocess.run([*run, *several, *short], capture_output=True, text=True, check=False)
    assert done.returncode == 1  # one of the two is refused
    said = done.stdout.splitlines()
    head, *lines = said[said.index("2 runs") + 1 :]
    assert head.split()[0] == "fusion"
    assert [line.split()[0] for line in lines] == ["none", "self"]
    assert str(tmp_path / "runs") in lines[0]
    assert "failed: config: fusion must be none with sharing=none" in lines[1]
    assert not list(tmp_path.glob("multirun/.notes-*"))

    again = subprocess.run(
        [*run, "fusion=none", *short], capture_output=True, text=True, check=True
    )
    assert again.stdout.startswith("already done, nothing computed\n")
    assert "this run exists" not in again.stderr
