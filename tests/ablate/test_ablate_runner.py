"""The runner with runs that only pretend: what is run, tried again, given up, stopped and written."""

import json
import os
import shlex
import shutil
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import ablate_fakes
import pytest
from slow import with_slow

from vlgs.ablate import __main__ as runner
from vlgs.ablate import job
from vlgs.ablate.__main__ import Request, ablate, read
from vlgs.ablate.job import JobOutcome, read_outcome, run_and_record
from vlgs.ablate.plan import plan
from vlgs.ablate.progress import Count, count
from vlgs.config import override_value
from vlgs.runs import STOPPED, UNSCORED
from vlgs.tables.benchmark import Benchmark
from vlgs.tables.registry import Table, load_table


@pytest.fixture(autouse=True)
def fakes(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.setenv("VLGS_FAKES", str(tmp_path_factory.getbasetemp()))
    monkeypatch.setattr(job, "RUN", (sys.executable, ablate_fakes.__file__))
    monkeypatch.setattr(job, "POLL_SECONDS", 0.05)
    monkeypatch.setattr(runner, "WAIT_SECONDS", 0.1)


@pytest.fixture
def table(tmp_path: Path) -> Table:
    path = tmp_path / "tiny.yaml"
    path.write_text(ablate_fakes.TABLE)
    return load_table(path)


def request_of(
    table: Table, results: Path, seeds: tuple[int, ...] = (0,), dry: bool = False
) -> Request:
    benchmark = Benchmark("synthetic", ("data=synthetic",), ("glassware",), seeds)
    results.mkdir(exist_ok=True)
    return Request([table], benchmark, results, (), dry)


def behave(results: Path, **acts: list[str]) -> None:
    results.mkdir(exist_ok=True)
    named = {f"{name.rstrip('0123456789')} glassware {name[-1]}": a for name, a in acts.items()}
    (results / "behave.json").write_text(json.dumps(named))


def ran(results: Path) -> list[str]:
    return (results / "ran.txt").read_text().splitlines()


def test_what_is_missing_is_run_once_and_the_tables_are_written(
    table: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    results = tmp_path / "r"
    assert ablate(request_of(table, results)) == 0
    assert sorted(ran(results)) == ["none glassware 0", "self glassware 0"]
    folder = results / "synthetic"
    names = {path.name for path in folder.iterdir()}
    assert names >= {
        "benchmark.yaml",
        "tiny.csv",
        "tiny.md",
        "tiny.tex",
        "tables.tex",
        "index.html",
    }
    assert "50.0" in (folder / "tiny.md").read_text()
    assert "2 runs: 2 done" in capsys.readouterr().out
    assert ablate(request_of(table, results)) == 0
    assert len(ran(results)) == 2
    assert ablate(request_of(table, results, seeds=(0, 1))) == 0  # extends
    assert len(ran(results)) == 4
    assert Benchmark.read(folder / "benchmark.yaml").seeds == (0, 1)


@pytest.mark.slow
def test_rows_of_runs_csv_are_not_run_again_where_their_folders_are_gone(
    table: Table, tmp_path: Path
):
    results = tmp_path / "r"
    assert ablate(request_of(table, results)) == 0
    written = (results / "synthetic" / "tiny.csv").read_text()
    shutil.rmtree(results / "runs")  # as in a clone
    assert ablate(request_of(table, results)) == 0
    assert len(ran(results)) == 2
    assert (results / "synthetic" / "tiny.csv").read_text() == written
    assert ablate(request_of(table, results, seeds=(0, 1))) == 0
    assert sorted(ran(results)[2:]) == ["none glassware 1", "self glassware 1"]
    (results / "runs.csv").unlink()
    shutil.rmtree(results / "runs")
    assert ablate(request_of(table, results)) == 0
    assert len(ran(results)) == 6


def test_the_page_keeps_the_tables_that_were_there(
    table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    results, other = tmp_path / "r", replace(table, label="other")
    known = {"other": other, "tiny": table, "third": replace(table, label="third")}
    monkeypatch.setattr(runner, "load_tables", lambda: known)
    for one in (table, other):
        assert ablate(request_of(one, results)) == 0
    page = (results / "synthetic" / "index.html").read_text()
    assert "tab:tiny" in page
    assert "tab:other" in page
    assert "tab:third" not in page  # nobody asked for it


def test_a_failure_is_shown_with_its_log_and_the_others_go_on(
    table: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    results = tmp_path / "r"
    behave(results, none0=["error"])
    assert ablate(request_of(table, results)) == 1
    out = capsys.readouterr().out
    assert "exit status 1" in out
    assert "error: fake: scene must be good, got bad" in out
    log = Path(out.partition("log: ")[2].split("\n")[0])
    assert "fusion=none" in log.read_text()
    assert sorted(ran(results)) == ["none glassware 0", "self glassware 0"]
    assert "--" in (results / "synthetic" / "tiny.md").read_text()


def test_where_every_run_fails_no_table_is_written(
    table: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    results = tmp_path / "r"
    behave(results, none0=["error"], self0=["error"])
    assert ablate(request_of(table, results)) == 1
    assert capsys.readouterr().out.count("error: fake: scene must be good, got bad") == 2
    names = {path.name for path in (results / "synthetic").iterdir()}
    assert names == {"benchmark.yaml", "recipes.json"}
    assert not (results / "runs.csv").exists()


@pytest.mark.slow
def test_where_every_new_run_fails_rows_of_runs_csv_are_still_written(table: Table, tmp_path: Path):
    results = tmp_path / "r"
    assert ablate(request_of(table, results)) == 0
    shutil.rmtree(results / "runs")
    page = results / "synthetic" / "tiny.md"
    page.unlink()
    behave(results, none1=["error"], self1=["error"])
    assert ablate(request_of(table, results, seeds=(0, 1))) == 1
    assert "50.0" in page.read_text()


def test_a_killed_run_is_tried_again_but_not_for_ever(
    table: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    results = tmp_path / "r"
    behave(results, none0=["kill", "ok"], self0=["kill"] * 9)
    assert ablate(request_of(table, results)) == 1
    assert ran(results).count("none glassware 0") == 2
    assert ran(results).count("self glassware 0") == runner.TRIES
    assert "killed by signal 9 (out of memory?)" in capsys.readouterr().out


def test_runs_of_another_process_are_waited_for(
    table: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    results = tmp_path / "r"
    behave(results, none0=["busy", "busy"], self0=["busy"])
    assert ablate(request_of(table, results)) == 0
    assert "waiting for another process" in capsys.readouterr().out


def test_results_of_another_row_end_the_waiting(
    table: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    results = tmp_path / "r"
    behave(results, none0=["other"])
    assert ablate(request_of(table, results)) == 1
    assert "its results are not those of this row" in capsys.readouterr().out
    assert ran(results).count("none glassware 0") == 1


def test_ctrl_c_lets_the_runs_save_and_the_same_command_goes_on(table: Table, tmp_path: Path):
    results = tmp_path / "r"
    behave(results, none0=["wait"])
    before = signal.getsignal(signal.SIGINT)  # ignored where pytest runs in the background

    def press() -> None:
        while not (results / "waiting").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=press)
    thread.start()
    assert ablate(request_of(table, results)) == STOPPED
    thread.join()
    assert ran(results) == ["none glassware 0"]  # the next one was not begun
    assert signal.getsignal(signal.SIGINT) is before
    (outcome,) = [
        read_outcome(folder, 0) for folder in (results / "logs").iterdir() if folder.is_dir()
    ]
    assert outcome.status == STOPPED  # it was told, and saved
    assert not list((results / "logs").rglob("0001*"))  # nor looked at
    assert ablate(request_of(table, results)) == 0


def test_logs_of_jobs_name_no_folder_of_this_machine(
    table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "Jane Doe").mkdir()
    monkeypatch.chdir(tmp_path / "Jane Doe")
    assert ablate(request_of(table, Path("r"))) == 0
    logs = [path for path in Path("r/logs").rglob("*") if path.is_file()]
    assert len(logs) >= 4
    for path in logs:
        assert str(tmp_path) not in path.read_text()
    (log,) = (path for path in logs if path.name.startswith("0000_"))
    assert log.read_text().startswith("python -m vlgs.run ")
    assert "results=r " in log.read_text()


def test_a_stop_reaches_jobs_that_have_not_begun(tmp_path: Path):
    (tmp_path / job.STOP).touch()
    run_and_record(tmp_path, 3, ["fusion=none"])
    assert read_outcome(tmp_path, 3).status == STOPPED
    assert not list(tmp_path.glob("*.log"))


def test_dry_says_what_would_run_and_writes_nothing(
    table: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    results = tmp_path / "r"
    assert ablate(request_of(table, results, dry=True)) == 0
    out = capsys.readouterr().out
    assert "python -m vlgs.run data=synthetic fusion=none data.scene=glassware seed=0" in out
    assert not any(results.iterdir())


def test_a_benchmark_extends_or_refuses(tmp_path: Path):
    path = tmp_path / "b" / "benchmark.yaml"
    first = Benchmark("b", ("data=synthetic", "threads=1", "data.root=/x"), ("glassware",), (0, 1))
    first.extend(path)
    assert Benchmark.read(path) == Benchmark("b", ("data=synthetic",), ("glassware",), (0, 1))
    second = Benchmark("b", ("data=synthetic", "threads=2"), ("mirrors",), (4,))
    assert second.extend(path).scenes == ("glassware", "mirrors")
    assert Benchmark.read(path).seeds == (0, 1, 4)
    before = path.read_text()
    with pytest.raises(
        ValueError, match=r"name must be new for other overrides, got name=b, .*trainer=smoke"
    ):
        Benchmark("b", ("data=synthetic", "trainer=smoke"), ("glassware",), (0,)).extend(path)
    assert path.read_text() == before


def test_rows_that_are_one_run_are_planned_once(table: Table):
    benchmark = Benchmark("b", ("data=synthetic",), ("glassware", "mirrors"), (0, 1))
    planned = plan([table, table], benchmark)
    assert len(planned) == len({run.key for run in planned}) == 2 * 2 * 2
    assert [run.identity.seed for run in planned] == [0] * 4 + [1] * 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["scenes=a"], "tab must be given"),
        (["tab=ab-multi", "fast"], "arguments must be KEY=VALUE, got fast"),
        (["tab=ab-multi", "--config-dir=mine"], "config-dir must be left out"),
        (["tab=ab-mutli"], "tab: must be all, one of"),
        (["tab=ab-multi", "seeds=many"], "seeds must be a count or a list of integers, got many"),
        (["tab=ab-multi", "seeds=0"], "seeds must be given, each once, got none"),
        (["tab=ab-multi", "seed=3"], "seeds must be given as seeds=, got seed=3"),
        (["tab=ab-multi", "scenes=a,a"], "scenes must be given, each once, got a, a"),
        (["tab=ab-multi", "name=a/b"], "name must be a folder's name, got 'a/b'"),
        (["tab=ab-multi", "data=colmap"], "data.root must be given with data=colmap"),
        (["tab=ab-multi", "dry=maybe"], "dry must be true or false, got maybe"),
    ],
)
def test_a_slip_on_the_command_line_is_named(arguments: list[str], message: str):
    with pytest.raises(ValueError, match=message):
        read(arguments)


def test_an_unknown_launcher_is_one_error(table: Table, tmp_path: Path):
    request = request_of(table, tmp_path / "r")
    slip = Request([table], request.benchmark, request.results, ("hydra/launcher=jolib",), False)
    with pytest.raises(ValueError, match="hydra/launcher must exist and be installed"):
        ablate(slip)


def test_the_command_line_is_split():
    request = read(
        [
            "tab=ab-cam",
            "data=colmap",
            "data.root=/a/photos",
            "seeds=4,7",
            "hydra/launcher=processes",
            "threads=1",
        ]
    )
    assert request.benchmark.name == "photos"
    assert request.benchmark.scenes == ("photos",)
    assert request.benchmark.seeds == (4, 7)
    assert request.benchmark.recorded == ("data=colmap",)
    assert request.launcher == ("hydra/launcher=processes", "threads=1")


def test_outcomes_are_told_apart():
    assert JobOutcome(0).done
    assert JobOutcome(UNSCORED).done
    assert JobOutcome(None, 0.0, "x").lost
    assert JobOutcome(-9).lost
    assert JobOutcome(STOPPED).lost  # by someone else: a queue that wants its machine back
    assert not JobOutcome(1).lost
    assert JobOutcome().reason() == "it was never started"


def test_progress_counts_and_estimates():
    before = Count(total=10, done=3, failed=1, seconds_per_run=100.0)
    jobs = [JobOutcome(0, 30.0, "a"), JobOutcome(0, 50.0, "b"), JobOutcome(1, 5.0, "c"), JobOutcome(75, 5.0, "d"),
            JobOutcome(None, 10.0, "e"), JobOutcome(None, 10.0, "f"), JobOutcome()]  # fmt: skip
    now = count(before, jobs)
    assert (now.done, now.running, now.failed, now.remaining) == (5, 2, 2, 3)
    assert now.seconds_per_run == 40.0
    # Three remain, two of them half done: two runs' work on two workers.
    assert now.line().endswith("3 remaining, about 40 s left")
    assert "left" not in Count(total=2, done=0).line()


@pytest.mark.parametrize(
    ("overrides", "scenes", "told"),
    [
        (("data=synthetic",), ("mirrors",), True),
        (("data=colmap", "data.root=/a/photos"), ("photos",), False),
        (("data=colmap", "data.root=/a"), ("one", "two"), True),
        (("data=lerf_ovs", "data.root=/a"), ("ramen",), True),
    ],
)
def test_a_run_is_told_its_scene_unless_the_folder_is_the_scene(
    overrides: tuple[str, ...], scenes: tuple[str, ...], told: bool, table: Table
):
    runs = plan([table], Benchmark("b", overrides, scenes, (0,)))
    assert {any(o.startswith("data.scene=") for o in run.overrides) for run in runs} == {told}


def test_a_scene_file_is_one_scene_with_the_name_of_the_file(table: Table):
    request = runner.read(["tab=ab-cam", "data.scene=mine/breakfast.yaml", "seeds=1"])
    assert request.benchmark.scenes == ("breakfast",)
    runs = plan([table], request.benchmark)
    told = [[o for o in run.overrides if o.startswith("data.scene=")] for run in runs]
    assert told == [["data.scene=mine/breakfast.yaml"]] * len(runs)
    assert {run.scene for run in runs} == {"breakfast"}


def test_runs_that_were_never_started_are_not_given_up(table: Table):
    run = plan([table], Benchmark("b", ("data=synthetic",), ("glassware",), (0,)))[0]
    tally = runner.Tally()
    for _ in range(2 * runner.TRIES):
        tally.add(run, JobOutcome())
    assert not tally.failed
    for _ in range(runner.TRIES):
        tally.add(run, JobOutcome(None, 1.0, "begun.log"))
    assert "its worker died" in tally.failed[run.name]


def test_a_launcher_that_starts_nothing_is_an_error(
    table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def broken(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(job, "run_and_record", broken)
    with pytest.raises(ValueError, match="launcher must start jobs, got OSError: no space left"):
        ablate(request_of(table, tmp_path / "r"))


@pytest.mark.parametrize("name", with_slow(["Ünï dir", "a,b=[c] (d)", "it's"], ["Ünï dir", "it's"]))
def test_a_folder_may_have_any_name(table: Table, tmp_path: Path, name: str):
    results = tmp_path / name
    assert ablate(request_of(table, results)) == 0
    assert len(list(results.glob("runs/*/metrics.json"))) == 2
    assert (results / "synthetic" / "tiny.md").is_file()


def test_the_command_line_takes_a_folder_of_any_name_and_prints_it_quoted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    root = str(tmp_path / "Ünï, [dir] (1)")
    arguments = ["data=colmap", f"data.root={root}", f"results={root}", "tab=prune-on", "dry=true"]
    monkeypatch.setattr(sys, "argv", ["ablate", *arguments])
    with pytest.raises(SystemExit) as stop:
        runner.main()
    assert stop.value.code == 0
    printed = capsys.readouterr().out.splitlines()[1]
    words = shlex.split(printed)
    assert override_value(words[words.index("data=colmap") + 1]) == root
