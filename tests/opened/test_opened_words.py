"""Vectors of new words: from a text tower, once, and then from disk."""

from pathlib import Path

import pytest
import torch
from tiny_models import save_clip

from vlgs.data.language import write_vocabulary
from vlgs.opened.word_cache import CachedText, _weights_of, cache_folder
from vlgs.opened.words import Words
from vlgs.queries.text import ClipText
from vlgs.types import Vocabulary


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def tower_in(folder: Path) -> ClipText:
    """Of random weights."""
    save_clip(folder)
    return ClipText(model=str(folder))


@pytest.fixture
def tower(tmp_path: Path) -> ClipText:
    return tower_in(tmp_path / "clip")


def test_a_word_is_encoded_once(tower: ClipText, monkeypatch: pytest.MonkeyPatch):
    text = CachedText(tower)
    first = text.encode(["mug", "a red cup"])
    assert torch.equal(first, tower.encode(["mug", "a red cup"]))
    monkeypatch.setattr(tower, "encode", lambda names: pytest.fail(f"encodes {names} again"))
    assert torch.equal(text.encode(["a red cup", "mug"]), first[[1, 0]])


def test_weights_and_template_are_part_of_the_key(tower: ClipText, tmp_path: Path):
    plain = CachedText(tower).encode(["mug"])
    said = CachedText(tower, "a photo of a {}").encode(["mug"])
    assert torch.equal(said, tower.encode(["a photo of a mug"]))
    assert not torch.equal(plain, said)
    other = tower_in(tmp_path / "other")
    assert not torch.equal(CachedText(other).encode(["mug"]), plain)
    with pytest.raises(ValueError, match=r"template must contain {} once"):
        CachedText(tower, "a mug")


def test_every_file_of_the_model_is_part_of_the_key(tower: ClipText, tmp_path: Path):
    folder = tmp_path / "clip"
    first = CachedText(tower).encode(["mug"])
    file = folder / "tokenizer.json"  # other tokens for the same letters
    file.write_text(file.read_text().replace('"m"', '"?"').replace('"b"', '"m"'))
    changed = ClipText(model=str(folder))
    second = CachedText(changed).encode(["mug"])
    assert not torch.equal(second, first)
    assert torch.equal(second, changed.encode(["mug"]))
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    before = _weights_of(str(folder))
    (folder / "pytorch_model.bin").write_bytes(b"others")
    assert _weights_of(str(folder)) != before


@pytest.mark.parametrize("table", ["own", "further"])
def test_a_word_that_is_kept_must_be_as_wide_as_the_run(
    tower: ClipText, tmp_path: Path, table: str
):
    assert CachedText(tower).encode(["mug"]).shape == (1, 12)
    wide = Vocabulary(("cup",), torch.eye(1, 64))
    write_vocabulary(tmp_path / "wide.npz", wide)
    own, further = (wide, None) if table == "own" else (None, tmp_path / "wide.npz")
    words = Words.of(own, {}, further, tower.model, "{}")
    for names in (["mug"], ["cup", "mug"], ["mug", "bear"]):
        with pytest.raises(ValueError, match=r"as wide as the scene's vocabulary \(64\), got 12"):
            words.encode(names)


def test_a_damaged_cache_is_made_anew(tower: ClipText):
    first = CachedText(tower).encode(["mug"])
    (file,) = cache_folder().iterdir()
    file.write_bytes(b"half of a fi")
    assert torch.equal(CachedText(tower).encode(["mug"]), first)
    assert len(file.read_bytes()) > 100


def test_a_cache_that_cannot_be_written_costs_nothing_but_time(
    tower: ClipText, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "taken").write_text("a file")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "taken"))
    assert CachedText(tower).encode(["mug"]).shape[0] == 1


def test_tables_come_before_the_tower_and_the_order_is_kept(tower: ClipText):
    width = tower.encode(["x"]).shape[1]
    own = Vocabulary(("mug", "cup"), torch.eye(2, width))
    words = Words([*Words.of(own, {}, None, None, "{}").tables], CachedText(tower))
    got = words.encode(["cup", "zebra", "mug"])
    assert torch.equal(got[[2, 0]], own.vectors)
    assert torch.equal(got[1], tower.encode(["zebra"])[0])


def test_what_cannot_be_encoded_is_told_what_can(tmp_path: Path):
    with pytest.raises(
        ValueError, match=r"'mug' must be encoded, got neither a vocabulary nor.*--text"
    ):
        Words.of(None, {}, None, None, "{}").encode(["mug"])
    missing = Words.of(None, {}, None, str(tmp_path / "nowhere"), "{}")
    pytest.importorskip("transformers")
    with pytest.raises(OSError, match="weights must be on this machine"):
        missing.encode(["mug"])
