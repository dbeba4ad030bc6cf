"""A file or a folder to start from counts by its content."""

from pathlib import Path

import pytest

from vlgs.formats import file_digest, folder_digest


def test_a_file_counts_by_its_content_and_has_to_be_there(tmp_path: Path):
    for name, content in (("a.ply", b"1"), ("b.ply", b"1"), ("c.ply", b"2")):
        (tmp_path / name).write_bytes(content)
    first, same, other = (file_digest(tmp_path / f"{name}.ply") for name in "abc")
    assert first == same != other
    with pytest.raises(FileNotFoundError, match="init must be a file"):
        file_digest(tmp_path / "none.ply")


def test_a_folder_counts_by_what_is_in_it(tmp_path: Path):
    for place in ("a", "b"):
        (tmp_path / place / "deep").mkdir(parents=True)
        (tmp_path / place / "one").write_bytes(b"1")
        (tmp_path / place / "deep" / "two").write_bytes(b"2")
    first = folder_digest(tmp_path / "a", "maps")
    assert folder_digest(tmp_path / "b", "maps") == first
    (tmp_path / "b" / "deep" / "two").write_bytes(b"3")
    assert folder_digest(tmp_path / "b", "maps") != first
    (tmp_path / "a" / "one").rename(tmp_path / "a" / "three")
    assert folder_digest(tmp_path / "a", "maps") != first
    with pytest.raises(FileNotFoundError, match="run: maps must be a folder, got"):
        folder_digest(tmp_path / "none", "maps")
