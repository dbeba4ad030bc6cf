"""What a run does when something happens to its folder, its files or its terminal."""

import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from tiny_runs import TINY, composed

from vlgs.places import found_again, record
from vlgs.run import run
from vlgs.runs import STOPPED, RunFolder
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.curves import read_rows
from vlgs.training.lightning import VLGSModule

SHORT = (
    *(*TINY, "trainer=smoke", "trainer.iterations=9", "trainer.checkpoint_every=3"),
    *("trainer.log_every=2", "pictures=false", "threads=1", "head.training.steps=5"),
    *("data.width=24", "data.height=18", "data.train_views=3", "data.test_views=1"),
    *("data.points=60", "protocol=dense"),
)


def only_run(results: Path) -> RunFolder:
    (path,) = (results / "runs").iterdir()
    return RunFolder(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run that nothing happened to."""
    results = tmp_path_factory.mktemp("whole")
    assert run(composed(*SHORT, f"results={results}")) == 0
    return only_run(results)


def unfinished(whole: RunFolder, results: Path) -> RunFolder:
    """A copy that has not reported."""
    path = results / "runs" / whole.path.name
    shutil.copytree(whole.path, path)
    shutil.copytree(whole.path.parents[1] / "cache", results / "cache")
    folder = RunFolder(path)
    folder.metrics.unlink()
    folder.ply.unlink()
    return folder


def at_step(monkeypatch: pytest.MonkeyPatch, step: int, act: Callable[[], None]) -> None:
    """Let something happen within a step."""
    original = VLGSModule.training_step

    def training_step(self: VLGSModule, index: int, batch_idx: int) -> None:
        original(self, index, batch_idx)
        if index == step:
            act()

    monkeypatch.setattr(VLGSModule, "training_step", training_step)


def steps_of(log: Path) -> list[str]:
    return [line.split(",")[0] for line in log.read_text().splitlines()]


def remade(path: Path) -> None:
    shutil.rmtree(path)
    path.mkdir()
    (path / ".lock").touch()


@pytest.mark.parametrize(
    ("act", "step"),
    [
        (shutil.rmtree, 8),  # the last
        (remade, 3),
        pytest.param(lambda path: path.rename(path.with_name("moved")), 4, marks=pytest.mark.slow),
    ],
)
def test_a_run_whose_folder_goes_ends_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: Callable[[Path], None], step: int
):
    at_step(monkeypatch, step, lambda: act(only_run(tmp_path).path))
    with pytest.raises(FileNotFoundError, match=r"run: .*/runs/\w+ must stay in its place"):
        run(composed(*SHORT, f"results={tmp_path}"))
    left = [p for p in (tmp_path / "runs").glob("*") if p.name != "moved"]
    assert not [p for path in left for p in path.iterdir() if p.name != ".lock"]


def test_what_can_be_made_again_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: RunFolder
):
    def act() -> None:
        shutil.rmtree(only_run(tmp_path).checkpoint)
        only_run(tmp_path).curves.unlink()

    at_step(monkeypatch, 4, act)
    assert run(composed(*SHORT, f"results={tmp_path}")) == 0
    folder = only_run(tmp_path)
    assert folder.ply.read_bytes() == whole.ply.read_bytes()
    assert steps_of(folder.curves) == ["step", "6", "8"]
    assert load_checkpoint(folder.checkpoint).step == 9  # type: ignore[union-attr]


def test_a_damaged_checkpoint_gives_way_to_the_one_before_and_the_bits_are_the_same(
    tmp_path: Path, whole: RunFolder, caplog: pytest.LogCaptureFixture
):
    folder = unfinished(whole, tmp_path)
    newest = folder.checkpoint / "step_00000009.safetensors"
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 4
    newest.write_bytes(data)
    assert run(composed(*SHORT, f"results={tmp_path}")) == 0
    (said,) = [text for text in caplog.messages if text.startswith("checkpoint:")]
    assert "step_00000009.safetensors does not match its digest" in said
    assert "step_00000006.safetensors is taken instead" in said
    assert folder.ply.read_bytes() == whole.ply.read_bytes()
    names = sorted(path.name for path in folder.checkpoint.iterdir())
    assert names == ["step_00000006.safetensors", "step_00000009.safetensors"]


def test_a_damaged_log_is_no_reason_to_stop(
    tmp_path: Path, whole: RunFolder, caplog: pytest.LogCaptureFixture
):
    folder = unfinished(whole, tmp_path)
    (folder.checkpoint / "step_00000009.safetensors").unlink()
    rows = folder.curves.read_bytes().splitlines(keepends=True)
    damaged = b"".join([*rows[:2], b"\r\n", b"\xff\xfe,1,2,3,4,5\r\n", rows[2], rows[3][:-3]])
    folder.curves.write_bytes(damaged)
    (folder.path / ".metrics.json.1-0123abcd.tmp").write_text("litter of the dead")
    assert run(composed(*SHORT, f"results={tmp_path}")) == 0
    assert steps_of(folder.curves) == ["step", "2", "4", "8"]
    (warned,) = [text for text in caplog.messages if text.startswith("log:")]
    assert "has 3 rows that cannot be read" in warned
    assert folder.ply.read_bytes() == whole.ply.read_bytes()
    assert not list(folder.path.rglob("*.tmp"))


ROW = b"2,0.5,20,100,0.1,3\r\n"
HEADER = b"step,loss,psnr,n_gaussians,blend_weight,seconds\r\n"


@pytest.mark.parametrize(
    ("content", "rows"),
    [
        (HEADER + ROW, 1),
        (b"\xef\xbb\xbf" + HEADER + ROW, 1),  # as a spreadsheet writes it
        (b"", 0),
        (ROW, 1),  # without its header
        (HEADER + b"\n\n" + ROW, 1),
        (HEADER + b"2\0,0.5,20,100,0.1,3\n", 0),
        (HEADER + b"2,0.5,\xff,100,0.1,3\n", 0),
        (HEADER + b"2,0.5,20,100,0.1,3", 0),  # may be cut in a number
        (HEADER + b"2,0.5,20\n", 0),
        (HEADER + b"2.5,0.5,20,100,0.1,3\n", 0),
        (b"mine,seconds,step,loss,psnr,n_gaussians,blend_weight\nx,3,2,0.5,20,100,0.1\n", 1),
        (b"step,mine\n2,0.5\n", 0),
        (bytes(range(256)) * 20, 0),
        (HEADER + b'"' + ROW * 9, 8),
    ],
)
def test_of_a_log_what_reads_is_kept(tmp_path: Path, content: bytes, rows: int):
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    assert read_rows(path) == [["2", "0.5", "20", "100", "0.1", "3"]] * rows


def test_a_closed_terminal_saves_unless_it_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def hang_up() -> None:
        for _ in range(2):  # the shell's and the kernel's
            os.kill(os.getpid(), signal.SIGHUP)

    at_step(monkeypatch, 4, hang_up)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        ignored = composed(*SHORT, f"results={tmp_path / 'nohup'}")
        assert run(ignored) == 0
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        assert run(composed(*SHORT, f"results={tmp_path / 'terminal'}")) == STOPPED
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)
    checkpoint = load_checkpoint(only_run(tmp_path / "terminal").checkpoint)
    assert checkpoint is not None
    assert checkpoint.step == 5


@pytest.mark.slow
def test_a_terminal_that_is_gone_does_not_end_what_is_being_saved(tmp_path: Path):
    overrides = [*SHORT, "trainer.iterations=4000", "progress=true", f"results={tmp_path}"]
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "vlgs.run", *overrides],
        stdin=slave, stdout=slave, stderr=slave, start_new_session=True,
        preexec_fn=lambda: __import__("fcntl").ioctl(0, __import__("termios").TIOCSCTTY, 0),
    )  # fmt: skip
    os.close(slave)
    deadline = time.monotonic() + 240
    while not list(tmp_path.glob("runs/*/checkpoint/*")) and time.monotonic() < deadline:
        os.read(master, 4096)
    os.close(master)
    assert process.wait(timeout=60) == STOPPED
    checkpoint = load_checkpoint(only_run(tmp_path).checkpoint)
    assert checkpoint is not None
    logged = int(steps_of(only_run(tmp_path).curves)[-1])
    assert checkpoint.step >= logged


def test_no_place_of_the_machine_is_written(
    tmp_path: Path, whole: RunFolder, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("HOME", "/home/somebody")
    config = composed(*SHORT, f"results={tmp_path}", "data.cache=${results}/cache")
    before = OmegaConf.to_yaml(config)
    for root, kept in (
        ("/mnt/disk/scene", "scene"),
        ("/home/somebody/a/scene", "~/a/scene"),
        (f"{Path.cwd()}/a/scene", "a/scene"),
        ("../a/scene", "../a/scene"),
    ):
        config.data.scene = root
        assert record(config)["data"]["scene"] == kept
    assert record(config)["data"]["cache"] == "${results}/cache"
    assert record(config)["results"] == tmp_path.name
    config.data.scene = "glassware"
    assert OmegaConf.to_yaml(config) == before, "what is recorded must not change what is run"
    again = found_again(whole.path)
    assert again.results == str(whole.path.parents[1])
    assert again.data.cache == f"{again.results}/cache"
    meta = load_checkpoint(whole.checkpoint).meta  # type: ignore[union-attr]
    assert meta["config"] == OmegaConf.to_container(OmegaConf.load(whole.config))
    assert json.loads(json.dumps(meta)) == meta
