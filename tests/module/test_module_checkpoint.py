import errno
import json
import os
from pathlib import Path

import pytest
import torch

from vlgs.module.checkpoint import Checkpoint, load_checkpoint, save_checkpoint


def example(step: int) -> Checkpoint:
    return Checkpoint(
        step, {"a": torch.full((3, 2), float(step)), "n": torch.tensor(step)}, {"k": [1, "x"]}
    )


def test_round_trip_keeps_bits_and_meta(tmp_path: Path):
    save_checkpoint(tmp_path, example(7))
    loaded = load_checkpoint(tmp_path)
    assert loaded is not None
    assert (loaded.step, loaded.meta) == (7, {"k": [1, "x"]})
    assert torch.equal(loaded.tensors["a"], torch.full((3, 2), 7.0))
    assert loaded.tensors["n"].dtype == torch.int64


def test_no_checkpoint_is_none(tmp_path: Path):
    assert load_checkpoint(tmp_path / "nothing") is None


def test_newest_wins_and_older_ones_go(tmp_path: Path):
    save_checkpoint(tmp_path, example(5))
    save_checkpoint(tmp_path, example(10))
    loaded = load_checkpoint(tmp_path)
    assert loaded is not None
    assert loaded.step == 10
    assert [p.name for p in tmp_path.glob("*.safetensors")] == ["step_00000010.safetensors"]


@pytest.mark.parametrize("keep", [0, 4, 60, 200])
def test_a_cut_file_gives_way_to_the_one_before(tmp_path: Path, keep: int):
    older = save_checkpoint(tmp_path, example(5)).read_bytes()
    newer = save_checkpoint(tmp_path, example(10))
    (tmp_path / "step_00000005.safetensors").write_bytes(older)
    newer.write_bytes(newer.read_bytes()[:keep])
    loaded = load_checkpoint(tmp_path)
    assert loaded is not None
    assert loaded.step == 5


def test_a_flipped_bit_is_noticed(tmp_path: Path):
    path = save_checkpoint(tmp_path, example(5))
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(ValueError, match=r"must hold a readable file.*digest"):
        load_checkpoint(tmp_path)


def test_missing_latest_json_is_no_loss(tmp_path: Path):
    save_checkpoint(tmp_path, example(5))
    (tmp_path / "latest.json").unlink()
    loaded = load_checkpoint(tmp_path)
    assert loaded is not None
    assert loaded.step == 5


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    save_checkpoint(tmp_path, example(5))

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_checkpoint(tmp_path, example(10))
    monkeypatch.undo()
    loaded = load_checkpoint(tmp_path)
    assert loaded is not None
    assert loaded.step == 5
    assert not list(tmp_path.glob(".*.tmp")), "the half-written file must not stay behind"


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="needs /dev/full, a device that is always full"
)
def test_a_really_full_device_is_an_oserror(tmp_path: Path):
    from vlgs.files import write_atomically

    (tmp_path / "target.json").write_text("old")
    (tmp_path / f".target.json.{os.getpid()}.tmp").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left"):
        write_atomically(tmp_path / "target.json", b"new" * 10_000)
    assert (tmp_path / "target.json").read_text() == "old"


def test_a_foreign_safetensors_file_is_refused(tmp_path: Path):
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(1)}, tmp_path / "step_00000001.safetensors")
    with pytest.raises(ValueError, match="format"):
        load_checkpoint(tmp_path)


def test_a_pickle_is_never_run(tmp_path: Path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    torch.save({"a": Trap()}, tmp_path / "step_00000001.safetensors")
    with pytest.raises(ValueError, match="not a safetensors file"):
        load_checkpoint(tmp_path)
    assert not (tmp_path / "ran").exists()


def test_latest_json_names_the_file(tmp_path: Path):
    path = save_checkpoint(tmp_path, example(3))
    assert json.loads((tmp_path / "latest.json").read_text())["file"] == path.name
