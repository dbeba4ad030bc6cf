import errno
import fcntl
import hashlib
import json
import os
import resource
from pathlib import Path

import pytest
import torch
from safetensors.torch import save
from slow import with_slow

from vlgs.files import write_atomically
from vlgs.training.checkpoint import Checkpoint, keep_from, load_checkpoint, save_checkpoint


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


def test_the_two_newest_are_kept(tmp_path: Path):
    for step in (5, 10, 100_000_000):
        save_checkpoint(tmp_path, example(step))
    loaded = load_checkpoint(tmp_path)
    assert loaded is not None
    assert loaded.step == 100_000_000
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "step_00000010.safetensors",
        "step_100000000.safetensors",
    ]


def test_equal_checkpoints_are_equal_bytes(tmp_path: Path):
    tensors = {name: torch.full((3,), ord(name)) for name in "zebra"}
    written = set()
    for _ in range(20):  # safetensors' own header is in random order
        written.add(save_checkpoint(tmp_path, Checkpoint(1, tensors, {"k": 1})).read_bytes())
    assert len(written) == 1


@pytest.mark.parametrize("keep", [0, 4, 60, 200])
def test_a_cut_file_gives_way_to_the_one_before(
    tmp_path: Path, keep: int, caplog: pytest.LogCaptureFixture
):
    save_checkpoint(tmp_path, example(5))
    newer = save_checkpoint(tmp_path, example(10))
    newer.write_bytes(newer.read_bytes()[:keep])
    loaded = load_checkpoint(tmp_path)
    assert loaded is not None
    assert loaded.step == 5
    (said,) = caplog.messages
    assert "step_00000010" in said
    assert "step_00000005.safetensors is taken instead" in said
    keep_from(tmp_path, 5)
    assert [p.name for p in tmp_path.iterdir()] == ["step_00000005.safetensors"]


@pytest.mark.parametrize("bits", with_slow([1, 8], [8]))  # of every byte
@pytest.mark.usefixtures("unchecked")
def test_no_flipped_bit_is_taken(tmp_path: Path, bits: int):
    path = save_checkpoint(tmp_path, example(5))
    data = path.read_bytes()
    for place in range(len(data)):
        for bit in range(place % 8, place % 8 + bits):
            flipped = bytearray(data)
            flipped[place] ^= 1 << bit % 8
            path.write_bytes(flipped)
            with pytest.raises(ValueError, match="must hold a sound file, got step_00000005"):
                load_checkpoint(tmp_path)


def first_format(folder: Path) -> Path:
    """A checkpoint as vlgs wrote it before the digest stood inside."""
    header = {"format": "vlgs-checkpoint-1", "step": "5", "meta": '{"k": 1}'}
    data = save({"a": torch.arange(3.0)}, header)
    path = folder / "step_00000005.safetensors"
    path.write_bytes(data)
    digest = hashlib.blake2b(data, digest_size=16).hexdigest()
    latest = {"file": path.name, "step": 5, "blake2b": digest}
    (folder / "latest.json").write_text(json.dumps(latest))
    return path


def test_the_first_format_is_read_with_its_digest_only(tmp_path: Path):
    path = first_format(tmp_path)
    loaded = load_checkpoint(tmp_path)
    assert loaded is not None
    assert (loaded.step, loaded.meta) == (5, {"k": 1})
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"step_00000005\.safetensors does not match its digest"):
        load_checkpoint(tmp_path)
    first_format(tmp_path)
    (tmp_path / "latest.json").unlink()
    with pytest.raises(ValueError, match="does not match its digest; without the folder"):
        load_checkpoint(tmp_path)


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    save_checkpoint(tmp_path, example(5))

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*step_00000010\.safetensors'"):
        save_checkpoint(tmp_path, example(10))
    monkeypatch.undo()
    loaded = load_checkpoint(tmp_path)
    assert loaded is not None
    assert loaded.step == 5
    assert not list(tmp_path.glob(".*.tmp")), "the half-written file must not stay behind"


def test_a_file_that_may_not_grow_is_an_oserror(tmp_path: Path):
    (tmp_path / "target.json").write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            write_atomically(tmp_path / "target.json", b"new" * 10_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "target.json").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_what_the_dead_left_goes_and_what_the_living_write_stays(tmp_path: Path):
    dead = tmp_path / ".a.json.1-0123abcd.tmp"
    dead.write_text("half")
    (tmp_path / ".a.json.4711.tmp").write_text("half, of an older vlgs")
    living = tmp_path / f".b.json.{os.getpid()}-0123abcd.tmp"
    with living.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        write_atomically(tmp_path / "c.json", b"whole")
        assert sorted(p.name for p in tmp_path.iterdir()) == sorted([living.name, "c.json"])


def test_a_foreign_safetensors_file_is_refused(tmp_path: Path):
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(1)}, tmp_path / "step_00000001.safetensors")
    with pytest.raises(ValueError, match="has no header of format"):
        load_checkpoint(tmp_path)


def test_a_pickle_is_never_run(tmp_path: Path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    torch.save({"a": Trap()}, tmp_path / "step_00000001.safetensors")
    with pytest.raises(ValueError, match="not a safetensors file"):
        load_checkpoint(tmp_path)
    assert not (tmp_path / "ran").exists()
