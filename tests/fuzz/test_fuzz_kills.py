import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.fuzz.kills import Calls, Kill, chosen
from vlgs.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint


def save_three(folder: Path, kill: Kill | None, told: Path) -> int:
    """Three checkpoints, written by a child that may be killed at it; its exit status."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 1
    try:
        calls = Calls(folder, kill)
        calls.install()
        for step in (1, 2, 3):
            save_checkpoint(folder, Checkpoint(step, {"a": torch.full((3,), step)}, {}))
        told.write_text(json.dumps(calls.seen))
        status = 0
    finally:
        os._exit(status)


def test_a_save_killed_anywhere_leaves_what_was_saved_before(tmp_path: Path):
    told = tmp_path / "calls.json"
    assert save_three(tmp_path / "whole", None, told) == 0
    calls = json.loads(told.read_text())
    whole = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()}
    assert sorted(whole) == ["step_00000002.safetensors", "step_00000003.safetensors"]
    kills = [kill for (kill, *more) in chosen(calls, 0, 10**6) if not more]
    assert len(kills) >= 2 * len(calls)
    for number, kill in enumerate(kills):
        folder = tmp_path / str(number)
        assert save_three(folder, kill, told) == -signal.SIGKILL
        loaded = load_checkpoint(folder)
        done = calls[: kill.call - (kill.side != "after")]
        saved = sum(call.startswith("rename") for call in done)
        assert (0 if loaded is None else loaded.step) == saved
        for step in range(max(1, saved), 4):  # what the resume does
            save_checkpoint(folder, Checkpoint(step, {"a": torch.full((3,), step)}, {}))
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == whole


@pytest.mark.slow
def test_a_run_killed_around_its_last_save_goes_on_to_the_same_files():
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", "kills", "--count", "10"],
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "tried    10  right    10" in done.stdout
