import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_runs import TINY, composed

from tests.fuzz.commands import command as in_process
from vlgs.config import CONF
from vlgs.report.results import METRICS
from vlgs.run import run
from vlgs.runs import UNSCORED, RunFolder
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.lightning import VLGSModule

SHORT = (*TINY, "trainer=smoke", "trainer.iterations=30")


def command(*overrides: str) -> list[str]:
    return [sys.executable, "-m", "vlgs.run", *overrides]


def only_run(results: Path) -> RunFolder:
    (path,) = (results / "runs").iterdir()
    return RunFolder(path)


def contents(folder: Path) -> dict[str, bytes]:
    """File -> its bytes."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder with one finished run of the full model."""
    results = tmp_path_factory.mktemp("results")
    assert run(composed(*SHORT, f"results={results}")) == 0
    return results


def test_a_run_leaves_everything_the_manual_promises(finished: Path):
    folder = only_run(finished)
    metrics = json.loads(folder.metrics.read_text())
    kinds = {f"miou_{kind}" for kind in ("translucent_reflective", "other")}
    assert set(metrics) - kinds <= set(METRICS)
    for name in (
        "psnr",
        "ssim",
        "miou",
        "loc_acc",
        "fps_color",
        "fps_language",
        "fps_query",
        "train_seconds",
    ):
        assert metrics[name] is not None
        assert metrics[name] >= 0
    assert metrics["protocol"] == "dense@1/synthetic"
    assert metrics["config_hash"] == folder.path.name
    assert metrics["ply_bytes"] == folder.ply.stat().st_size
    assert set(metrics["per_category"]) >= {"wine glass", "wall"}
    assert metrics["test_views_seen"] == 0
    queries = json.loads(folder.queries.read_text())
    assert {row["protocol"] for row in queries} == {"dense@1/synthetic", "lerf_ovs@1/synthetic"}
    assert metrics["failure"] is None
    assert (folder.renders / "overview.png").is_file()
    views = [path for path in folder.renders.iterdir() if path.is_dir()]
    assert len(views) == 2
    pictures = {
        "photograph",
        "render",
        "features",
        "labels",
        "prediction",
        "indicator_minus_opacity",
    }
    for view in views:
        names = {path.stem for path in view.iterdir()}
        assert names >= pictures
        assert any(name.startswith("relevancy_") for name in names)
    assert folder.config.is_file()
    assert folder.curves.read_text().splitlines()[0].startswith("step,loss,psnr,n_gaussians")


def test_a_finished_run_is_reported_not_repeated(
    finished: Path, capsys: pytest.CaptureFixture[str]
):
    folder = only_run(finished)
    before = {
        path: path.stat().st_mtime_ns for path in folder.path.rglob("*") if path.name != ".lock"
    }
    assert run(composed(*SHORT, f"results={finished}", "threads=1", "pictures=false")) == 0
    assert "PSNR" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_finished_run_without_pictures_is_given_them(finished: Path, tmp_path: Path):
    shutil.copytree(finished, tmp_path / "copy")
    folder, given = only_run(tmp_path / "copy"), (*SHORT, f"results={tmp_path / 'copy'}")
    metrics, want = folder.metrics.read_bytes(), contents(folder.renders)
    shutil.rmtree(folder.renders)
    assert run(composed(*given, "pictures=false")) == 0
    assert not folder.renders.exists()
    said = in_process("run", given)
    assert "its pictures were drawn now, nothing else computed" in said.text
    assert contents(folder.renders) == want
    assert folder.metrics.read_bytes() == metrics
    shutil.rmtree(folder.renders)
    folder.field.unlink()
    said = in_process("run", given)
    assert f"pictures are not drawn: {folder.field} must be there, got none" in said.text


def test_a_run_without_the_scores_that_were_asked_for_fails(finished: Path, tmp_path: Path):
    shutil.copytree(finished, tmp_path / "copy")
    folder = only_run(tmp_path / "copy")
    metrics = json.loads(folder.metrics.read_text())
    folder.metrics.write_text(json.dumps(metrics | {"failure": "nothing could be scored"}))
    status = run(composed(*SHORT, f"results={tmp_path / 'copy'}", "pictures=false"))
    assert status == UNSCORED != 0


def test_an_existing_run_can_be_refused(finished: Path):
    with pytest.raises(
        FileExistsError, match=r"must not exist with on_existing=refuse; on_existing=resume goes on"
    ):
        run(composed(*SHORT, f"results={finished}", "on_existing=refuse"))


def test_an_unfinished_report_is_taken_up_without_training_again(finished: Path, tmp_path: Path):
    shutil.copytree(finished, tmp_path / "copy")
    folder = only_run(tmp_path / "copy")
    want = json.loads(folder.metrics.read_text())
    folder.metrics.unlink()
    assert run(composed(*SHORT, f"results={tmp_path / 'copy'}", "pictures=false")) == 0
    got = json.loads(folder.metrics.read_text())
    assert {k: got[k] for k in ("psnr", "miou", "per_view", "train_seconds")} == {
        k: want[k] for k in ("psnr", "miou", "per_view", "train_seconds")
    }


def test_a_run_in_use_is_refused(finished: Path):
    folder = only_run(finished)
    with folder.writing(), pytest.raises(BlockingIOError, match="must not be in use, got process"):
        run(composed(*SHORT, f"results={finished}"))


def test_a_word_that_the_vocabulary_lacks_ends_the_run_before_training(tmp_path: Path):
    from dataclasses import replace

    from omegaconf import open_dict

    import vlgs.data.synthetic as synthetic

    scene = synthetic.load_scene(width=48, height=36, train_views=6, test_views=2, points=400)
    odd = replace(scene, classes=("vine glass", *scene.classes[1:]))
    config = composed(*SHORT, f"results={tmp_path}")
    with open_dict(config), pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "load_scene", lambda **_: odd)
        synthetic.load_scene.__module__ = "vlgs.data.synthetic"
        with pytest.raises(ValueError, match=r"got 'vine glass' \(did you mean 'wine glass'"):
            run(config)
    assert not (tmp_path / "runs").exists()


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    original = VLGSModule.training_step

    def training_step(self: VLGSModule, step: int, batch_idx: int) -> None:
        original(self, step, batch_idx)
        if step == 4:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(VLGSModule, "training_step", training_step)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        said = in_process("run", [*SHORT, f"results={tmp_path}", "pictures=false"])
    finally:
        signal.signal(signal.SIGINT, before)
    assert said.status == 130, said.text
    told = "SIGINT: stopped and saved at step 5 of 30; the same command goes on from there"
    assert told in said.text
    assert "python -m vlgs.run" in said.text
    checkpoint = load_checkpoint(only_run(tmp_path).checkpoint)
    assert checkpoint is not None
    assert checkpoint.step == 5


@pytest.mark.slow
def test_ctrl_c_ends_a_process_that_saves(tmp_path: Path):
    overrides = (
        *TINY,
        "trainer=smoke",
        "trainer.iterations=4000",
        f"results={tmp_path}",
        "trainer.log_every=1",
        "pictures=false",
    )
    process = subprocess.Popen(
        command(*overrides), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 240
    logs: list[Path] = []
    while not (logs and len(logs[0].read_text().splitlines()) > 3) and time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
        logs = list(tmp_path.glob("runs/*/log.csv"))
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    match = re.search(
        r"SIGINT: stopped and saved at step (\d+) of 4000; the same command goes on from there",
        errors,
    )
    assert match, errors
    assert "python -m vlgs.run" in errors
    checkpoint = load_checkpoint(only_run(tmp_path).checkpoint)
    assert checkpoint is not None
    assert checkpoint.step == int(match[1])


@pytest.mark.parametrize(
    ("override", "words"),
    [
        (
            "fusion=sel",
            ["fusion must be one of cross, mlp, none, self, got sel; did you mean self?"],
        ),
        (
            "fusion.dmi=3",
            ["error: config: fusion.dmi must be a key", "fusion has color_dim, feature_dim"],
        ),
        ("seed=0.5", ["error: config: seed must be a whole number, got 0.5"]),
        (
            "fusion._target_=os.system",
            ["error: config: fusion._target_ must be one of vlgs.fusion.attention.CrossAttention"],
        ),
        ("data=colmap", ["error: config: data.root must be given"]),
        ("data=colmap data.root=/nowhere/at/all", ["error:", "/nowhere/at/all", "sparse"]),
        (
            "on_existing=overwrite",
            ["error: config: on_existing must be resume or refuse, got overwrite"],
        ),
        ("trainer.iterations=0", ["error: trainer: iterations must be 1 to 1e+09, got 0"]),
    ],
)
def test_bad_input_is_one_clear_error(tmp_path: Path, override: str, words: list[str]):
    extra = [] if "data=" in override else list(TINY)
    said = in_process("run", [*extra, *override.split(), f"results={tmp_path}"])
    assert said.status != 0
    assert "Traceback" not in said.text
    for word in words:
        assert word in said.text, said.text


def test_an_error_ends_the_process(tmp_path: Path):
    done = subprocess.run(
        command("seed=0.5", f"results={tmp_path}"), capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 1
    assert done.stderr == "error: config: seed must be a whole number, got 0.5\n"
    assert not done.stdout


def test_help_is_a_manual_and_needs_no_torch():
    code = (
        "import sys, vlgs.run; sys.argv = ['vlgs.run', '--help']\n"
        "try:\n    vlgs.run.main()\nexcept SystemExit:\n    pass\n"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout.rstrip().endswith("False"), "--help must stay light"
    for section in (
        "NAME",
        "SYNOPSIS",
        "EXAMPLES",
        "GROUPS",
        "FILES",
        "EXIT STATUS",
        "fusion: cross, mlp, none, self",
    ):
        assert section in done.stdout


@pytest.mark.slow
def test_garbage_is_looked_for_again_after_the_imports():
    program = """
import gc
from vlgs.imports import uncollected
with uncollected():
    assert not gc.isenabled()
    import vlgs.experiment
kept = gc.get_freeze_count()
assert gc.isenabled() and kept > 100_000
with uncollected():  # whoever runs a second time has garbage of their own
    assert gc.isenabled()
assert gc.get_freeze_count() == kept
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr


def test_a_multirun_makes_one_run_per_combination(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    empty = tmp_path / "elsewhere"
    empty.mkdir()
    monkeypatch.chdir(empty)
    few = ("trainer.iterations=3", "blend=none,fixed", "pictures=false")
    said = in_process("run", ["-m", *SHORT, *few, f"results={tmp_path}"])
    assert said.status == 0, said.text
    folders = [RunFolder(path) for path in (tmp_path / "runs").iterdir()]
    assert len(folders) == 2
    assert all(folder.finished() for folder in folders)
    assert not list(empty.iterdir()), "a sweep must leave nothing where it was started"
    assert [path.name for path in (tmp_path / "multirun").iterdir()] == ["multirun.yaml"]
    for path in tmp_path.rglob("*"):
        content = path.read_bytes() if path.is_file() else b""
        for place in (tmp_path, CONF.parent, Path.home()):
            assert f"{place}/".encode() not in content, path
            assert f"{tmp_path}\n".encode() not in content, path
