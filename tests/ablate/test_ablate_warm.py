"""Runs from a warm parent: the same ends, logs and numbers as those of processes that start from nothing."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import ablate_fakes
import pytest
from safetensors.torch import load_file
from tiny_runs import TINY

from vlgs.ablate import __main__ as runner
from vlgs.ablate import job, warm
from vlgs.ablate.__main__ import Request, ablate, read
from vlgs.ablate.job import leave_parent, read_outcome, run_and_record
from vlgs.ablate.warm import WarmParent, WarmRun
from vlgs.runs import STOPPED
from vlgs.tables.benchmark import Benchmark
from vlgs.tables.registry import load_table

HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(HERE), *sys.path]))
    monkeypatch.setattr(job, "POLL_SECONDS", 0.05)


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.setenv("VLGS_FAKES", str(tmp_path_factory.getbasetemp()))
    monkeypatch.setattr(warm, "MODULE", "ablate_fakes")
    monkeypatch.setattr(warm, "SHARED", ("ablate_fakes",))
    monkeypatch.setattr(job, "RUN", (sys.executable, "-c", "raise SystemExit(9)"))  # none runs cold
    monkeypatch.setattr(runner, "WAIT_SECONDS", 0.1)


def request_of(folder: Path, **acts: list[str]) -> Request:
    path = folder / "tiny.yaml"
    path.write_text(ablate_fakes.TABLE)
    (folder / "r").mkdir()
    named = {f"{name[:-1]} glassware {name[-1]}": a for name, a in acts.items()}
    (folder / "r" / "behave.json").write_text(json.dumps(named))
    benchmark = Benchmark("synthetic", ("data=synthetic",), ("glassware",), (0, 1))
    return Request([load_table(path)], benchmark, folder / "r", (), dry=False, warm=True)


def ended(run: WarmRun | None, seconds: float = 60.0) -> WarmRun:
    assert run is not None
    run.wait(seconds)
    return run


@pytest.mark.usefixtures("fakes")
def test_a_killed_child_takes_nothing_with_it_and_a_killed_parent_is_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    acts = {"none0": ["error"], "self0": ["kill", "ok"], "none1": ["orphan", "ok"]}
    request = request_of(tmp_path, **acts)
    assert ablate(request) == 1
    assert "error: fake: scene must be good, got bad" in capsys.readouterr().out
    ran = sorted((request.results / "ran.txt").read_text().splitlines())
    runs = ["none glassware 0", "none glassware 1", "self glassware 0", "self glassware 1"]
    assert ran == sorted([*runs, "self glassware 0", "none glassware 1"])
    assert len(list(request.results.glob("runs/*/metrics.json"))) == 3
    assert not job._parents


@pytest.mark.usefixtures("fakes")
def test_a_child_is_told_to_save(tmp_path: Path):
    request = request_of(tmp_path, self0=["wait"])
    begun, folder = request.results / "waiting", tmp_path / "logs"
    code = f"""
import sys, time
from pathlib import Path
while not Path({str(begun)!r}).exists(): time.sleep(0.05)
Path({str(folder / "stop")!r}).touch()
"""
    with subprocess.Popen([sys.executable, "-c", code]):
        overrides = ["data=synthetic", "data.scene=glassware", "seed=0"]
        run_and_record(folder, 0, [*overrides, f"results={request.results}"], warm=True)
    leave_parent()
    assert read_outcome(folder, 0).status == STOPPED


def test_without_a_parent_runs_start_cold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(warm, "SHARED", ("no_module_of_this_name",))
    monkeypatch.setattr(job, "RUN", (sys.executable, "-c", "print('cold')"))
    for number in range(2):
        run_and_record(tmp_path, number, ["seed=0"], warm=True)
        outcome = read_outcome(tmp_path, number)
        assert outcome.status == 0
        assert Path(outcome.log).read_text().splitlines()[1:] == ["cold"]
    leave_parent()


@pytest.mark.slow
def test_the_parent_has_one_thread_and_a_child_as_many_as_it_asks_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(warm, "MODULE", "warm_child")
    monkeypatch.setattr(warm, "SHARED", ("warm_child", "scipy.spatial"))
    log = tmp_path / "log"
    log.touch()
    found = []
    parent = WarmParent()
    for threads in ("2", "1", "2"):
        assert ended(parent.start([threads, str(tmp_path / "warm")], log)).returncode == 0
        assert os.listdir(f"/proc/{parent.pid}/task") == [str(parent.pid)]
        found.append((tmp_path / "warm").read_text().split())
    parent.close()
    cold = tmp_path / "cold"
    subprocess.run([sys.executable, "-m", "warm_child", "2", str(cold)], check=True)
    assert [threads for threads, _ in found] == ["2", "1", "2"]
    assert {digest for _, digest in found} == {cold.read_text().split()[1]}


def test_the_parent_ends_with_whoever_started_it():
    code = (
        "from vlgs.ablate import warm; import os, signal\n"
        "warm.SHARED = ()\nprint(warm.WarmParent().pid, flush=True)\nos.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    for _ in range(200):
        if not Path(f"/proc/{int(done.stdout)}").exists():
            return
        time.sleep(0.05)
    raise AssertionError("it is still there")


def test_the_command_line_asks_for_it():
    asked = ["tab=ab-cam", "scenes=glassware"]
    assert read(asked).warm
    assert not read([*asked, "warm=false"]).warm
    with pytest.raises(ValueError, match="warm must be true or false, got 1"):
        read([*asked, "warm=1"])
    assert replace(read(asked), warm=False) == read([*asked, "warm=false"])


@pytest.mark.slow
def test_a_warm_run_has_the_bits_of_a_cold_one(tmp_path: Path):
    arguments = [*TINY, "trainer=smoke", "trainer.iterations=30", "threads=2", "pictures=false"]
    log = tmp_path / "log"
    log.touch()
    parent = WarmParent()
    for seed in (0, 1):  # the second is not the first child
        place = [f"results={tmp_path / 'warm'}", f"seed={seed}"]
        assert ended(parent.start([*arguments, *place], log), 600.0).returncode == 0, (
            log.read_text()
        )
    parent.close()
    cold = [sys.executable, "-m", "vlgs.run", *arguments, f"results={tmp_path / 'cold'}", "seed=1"]
    subprocess.run(cold, check=True, capture_output=True)
    (run,) = (tmp_path / "cold" / "runs").iterdir()
    files = sorted(path.relative_to(run) for path in run.rglob("*.safetensors"))
    assert len(files) >= 3
    for file in files:
        one, other = load_file(run / file), load_file(tmp_path / "warm" / "runs" / run.name / file)
        assert one.keys() == other.keys()
        assert all(bool((one[key] == other[key]).all()) for key in one), file
