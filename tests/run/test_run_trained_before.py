"""Which finished runs lend their models to one that begins."""

import json
from pathlib import Path
from typing import Any

import pytest

from vlgs.report.provenance import machine
from vlgs.runs import RunFolder
from vlgs.trained_before import take_training

TRAINING = "0123456789abcdef"


def finished(results: Path, name: str, **metrics: Any) -> RunFolder:
    """A folder that has what is looked at."""
    folder = RunFolder(results / name)
    for part in (folder, folder.part("level_2/language")):
        part.checkpoint.mkdir(parents=True)
        (part.checkpoint / "step_00000009.safetensors").write_bytes(b"model")
        part.curves.write_text("iteration\n9\n")
    said = {
        "config_hash": name,
        "scene": "s",
        "seed": 0,
        "training": TRAINING,
        "machine": machine(),
    }
    maps = folder.part("augment").path / "language"
    maps.mkdir(parents=True)
    (maps / "added_0000.npz").write_bytes(b"dear")
    folder.metrics.write_text(json.dumps(said | metrics))
    return folder


def test_every_model_is_there_once_on_the_disk(tmp_path: Path):
    his, mine = finished(tmp_path, "a"), RunFolder(tmp_path / "b")
    mine.path.mkdir()
    taken = take_training(mine, TRAINING)
    assert taken is not None
    assert taken["config_hash"] == "a"
    for name in ("", "level_2/language"):
        (one,), (other,) = (tuple(f.part(name).checkpoint.iterdir()) for f in (his, mine))
        assert one.samefile(other)
        assert mine.part(name).curves.read_text() == "iteration\n9\n"
        assert not mine.part(name).curves.samefile(his.part(name).curves)  # a log is written to
    maps = "augment/language/added_0000.npz"
    assert (mine.path / maps).samefile(his.path / maps)
    assert not mine.metrics.exists()


@pytest.mark.parametrize(
    "metrics",
    [{"training": "f" * 16}, {"training": None}, {"machine": {**machine(), "threads": 99}}],
)
def test_models_of_another_training_or_machine_are_not_taken(
    tmp_path: Path, metrics: dict[str, Any]
):
    finished(tmp_path, "a", said_elsewhere=TRAINING, **metrics)
    mine = RunFolder(tmp_path / "b")
    mine.path.mkdir()
    assert take_training(mine, TRAINING) is None
    assert not any(mine.path.iterdir())


def test_damaged_runs_are_passed_over_and_training_that_has_begun_goes_on(tmp_path: Path):
    finished(tmp_path, "a").metrics.write_text(f'{{"training": "{TRAINING}"')
    finished(tmp_path, "c")
    mine = RunFolder(tmp_path / "b")
    mine.checkpoint.mkdir(parents=True)
    assert take_training(mine, TRAINING) is None
    mine.checkpoint.rmdir()
    taken = take_training(mine, TRAINING)
    assert taken is not None
    assert taken["config_hash"] == "c"
