"""Language maps in LangSplat's layout and vocabularies: read exactly or refused by name."""

import json
from pathlib import Path

import numpy as np
import pytest

from vlgs.data.diagnostics import SceneError
from vlgs.data.language import (
    MaskFiles,
    find_mask_files,
    mask_map_size,
    read_mask_ids,
    read_mask_vectors,
    read_vocabulary,
)


def unit_rows(n: int, width: int = 8, seed: int = 0) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(n, width))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def write(folder: Path, ids: np.ndarray, vectors: np.ndarray | None = None) -> MaskFiles:
    np.save(folder / "a_s.npy", ids)
    np.save(folder / "a_f.npy", unit_rows(6) if vectors is None else vectors)
    files = find_mask_files(folder, "a")
    assert files is not None
    return files


def levels() -> np.ndarray:
    """Ids of four levels, two rows each but for the first, which has none; -1 in the first column."""
    ids = np.zeros((4, 3, 4), np.float32)
    ids[0] = -1
    for level in (1, 2, 3):
        ids[level] = [-1, 2 * level - 2, 2 * level - 1, 2 * level - 1]
    return ids


def test_each_level_has_its_own_ids(tmp_path: Path):
    files = write(tmp_path, levels())
    assert mask_map_size(files) == (4, 3)
    assert (read_mask_ids(files, 0, 6) == -1).all()
    for level in (1, 2, 3):
        expected = [[-1, 2 * level - 2, 2 * level - 1, 2 * level - 1]] * 3
        np.testing.assert_array_equal(read_mask_ids(files, level, 6), expected)


@pytest.mark.parametrize("value", [6, 1e9, -2, 4.5, np.nan, np.inf])
def test_ids_out_of_range_name_the_place(tmp_path: Path, value: float):
    ids = levels()
    ids[3, 1, 2] = value
    files = write(tmp_path, ids)
    with pytest.raises(
        SceneError,
        match=r"a_s\.npy: ids of level 3 must be whole numbers from -1 to 5.*row 1, column 2",
    ):
        read_mask_ids(files, 3, 6)


def test_ids_that_start_anew_at_a_level_are_refused(tmp_path: Path):
    """They would silently pick the vectors of another level."""
    ids = levels()
    ids[3] = [-1, 0, 1, 1]
    with pytest.raises(SceneError, match=r"ids of level 3 must be above 3.*got 0"):
        read_mask_ids(write(tmp_path, ids), 3, 6)


@pytest.mark.parametrize("shape", [(3, 3, 4), (4, 4), (4, 3, 4, 1), (4, 0, 4)])
def test_a_map_of_another_shape_is_refused(tmp_path: Path, shape: tuple[int, ...]):
    with pytest.raises(SceneError, match=r"a_s\.npy: array must be numbers \[4, height, width\]"):
        mask_map_size(write(tmp_path, np.zeros(shape, np.float32)))


def test_arrays_of_objects_and_damaged_files_are_refused(tmp_path: Path):
    files = write(tmp_path, levels())
    np.save(files.ids, np.array([None]), allow_pickle=True)
    with pytest.raises(SceneError, match="content must be a whole npy array of numbers"):
        mask_map_size(files)
    np.save(files.ids, levels())
    whole = files.ids.read_bytes()
    for size in range(0, len(whole), 7):
        files.ids.write_bytes(whole[:size])
        with pytest.raises(SceneError, match=r"a_s\.npy: content must be a whole npy array"):
            mask_map_size(files)


def test_vectors_of_half_precision_are_made_unit(tmp_path: Path):
    rows = unit_rows(6).astype(np.float16)
    vectors = read_mask_vectors(write(tmp_path, levels(), rows))
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(vectors, rows, atol=1e-3)


def test_no_vectors_at_all_is_no_error(tmp_path: Path):
    assert read_mask_vectors(write(tmp_path, levels(), np.zeros((0, 8), np.float32))).shape == (
        0,
        8,
    )


@pytest.mark.parametrize("value", [0.0, 2.0, np.nan, np.inf, 1e30])
def test_vectors_that_are_not_unit_name_the_row(tmp_path: Path, value: float):
    rows = unit_rows(6)
    rows[4] = value
    with pytest.raises(
        SceneError, match=r"a_f\.npy: rows must be finite and of unit length, .* row 4 and 0 others"
    ):
        read_mask_vectors(write(tmp_path, levels(), rows))


def test_vectors_of_another_shape_are_refused(tmp_path: Path):
    with pytest.raises(SceneError, match=r"array must be floats \[M, e\], got int64 \[6\]"):
        read_mask_vectors(write(tmp_path, levels(), np.arange(6)))


def test_half_a_pair_is_no_language_map(tmp_path: Path):
    files = write(tmp_path, levels())
    files.vectors.unlink()
    assert find_mask_files(tmp_path, "a") is None


@pytest.mark.parametrize(("key", "name"), [("names", "v.npz"), ("classes", "v.NPZ")])
def test_vocabulary_of_an_npz(tmp_path: Path, key: str, name: str):
    path = tmp_path / name
    words = {key: np.array(["cup", "tea in a glass"])}
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **words, embeddings=7 * unit_rows(2))
    vocabulary = read_vocabulary(path)
    assert vocabulary.names == ("cup", "tea in a glass")
    np.testing.assert_allclose(vocabulary.vectors.numpy(), unit_rows(2), atol=1e-6)


def test_vocabulary_of_a_json(tmp_path: Path):
    path = tmp_path / "v.json"
    path.write_text(json.dumps({"cup": [3, 4], "jug": [0, 2]}))
    vocabulary = read_vocabulary(path)
    assert vocabulary.names == ("cup", "jug")
    np.testing.assert_allclose(vocabulary.vectors.numpy(), [[0.6, 0.8], [0, 1]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "content must be an npz"),
        ("[1]", "content must be an npz"),
        ("{}", "a row for each name"),
        ('{"a": [1, 2], "b": [1]}', "content must be an npz"),
        ('{"a": [1, 2], "b": [0, 0]}', "finite and not zero"),
        ('{"a": [1, NaN]}', "finite and not zero"),
        ('{"a": 1}', "a row for each name"),
        ('{"a": ["x"]}', "content must be an npz"),
    ],
)
def test_faulty_vocabularies_are_refused(tmp_path: Path, content: str, message: str):
    path = tmp_path / "v.json"
    path.write_text(content)
    with pytest.raises(SceneError, match=message):
        read_vocabulary(path)


def test_a_vocabulary_cannot_carry_objects(tmp_path: Path):
    path = tmp_path / "v.npz"
    np.savez(path, allow_pickle=True, names=np.array([object()]), embeddings=unit_rows(1))
    with pytest.raises(SceneError, match="content must be an npz"):
        read_vocabulary(path)
    with pytest.raises(FileNotFoundError, match="vocabulary: file must exist"):
        read_vocabulary(tmp_path / "none.npz")
