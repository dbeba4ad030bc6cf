"""Language supervision in LangSplat's layout: mask ids per pixel, a vector per mask, and a vocabulary.

``<stem>_s.npy`` [4, H, W] holds for each mask level (0 default, 1 subpart, 2 part, 3 whole) the mask that a pixel lies in, -1
for none; ids run on from level to level. ``<stem>_f.npy`` [M, e] holds one unit vector per id.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, Shaped

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.untrusted.arrays import Archive, map_npy
from vlgs.data.untrusted.text import read_json
from vlgs.files import write_atomically
from vlgs.types import Vocabulary

VOCABULARY_FILE = "vocabulary.npz"
"""Words and their vectors, in a folder of language maps."""
LEVELS = 4

_VOCABULARY = "an npz with names and embeddings or a JSON {name: vector}"


@dataclass(frozen=True)
class MaskFiles:
    """The two files of one view."""

    ids: Path
    vectors: Path


def find_mask_files(folder: Path, stem: str) -> MaskFiles | None:
    """The files of one view; None where one of them is missing."""
    files = MaskFiles(folder / f"{stem}_s.npy", folder / f"{stem}_f.npy")
    return files if files.ids.is_file() and files.vectors.is_file() else None


def mask_map_size(files: MaskFiles) -> tuple[int, int]:
    """Width and height of a mask map, from its header alone.

    Raises:
        SceneError: If the file is not an array [4, H, W].
    """
    shape = _open_ids(files.ids).shape
    return shape[2], shape[1]


def read_mask_ids(files: MaskFiles, level: int, n_vectors: int) -> Int32[np.ndarray, "h w"]:
    """Row of the view's own vectors per pixel, -1 where no mask lies.

    Args:
        files: Of one view.
        level: 0 default, 1 subpart, 2 part, 3 whole.
        n_vectors: Rows that the vector file has.

    Raises:
        SceneError: If an id is not a whole number from -1 to `n_vectors` - 1, or belongs to an earlier level.
    """
    levels = _open_ids(files.ids)
    raw = np.asarray(levels[level])
    with np.errstate(invalid="ignore"):  # what is no number becomes one that it is not equal to
        ids = raw.astype(np.int32)
    # One look at most maps; only of a faulty one it is asked where.
    if ids.size and not (np.array_equal(ids, raw) and ids.min() >= -1 and ids.max() < n_vectors):
        whole = np.isfinite(raw) & (raw >= -1) & (raw < n_vectors) & (raw == np.trunc(raw))
        at = np.argwhere(~whole)[0].tolist()
        expected = f"whole numbers from -1 to {n_vectors - 1}, the rows of {files.vectors.name}"
        what = f"ids of level {level} must be {expected}, got {raw[tuple(at)]} at row {at[0]}, column {at[1]}"
        raise SceneError(Fault(str(files.ids), what))
    # Unsigned, -1 is the largest.
    first = int(ids.view(np.uint32).min(initial=n_vectors))
    before = max((levels[lower].max() for lower in range(level)), default=-1)
    if first < n_vectors and not before < first:
        expected = f"above {before:.0f}, the last one of the levels before"
        what = f"ids of level {level} must be {expected}, got {first}"
        advice = "ids run on from level to level; these seem to start anew"
        raise SceneError(Fault(str(files.ids), what, advice))
    return ids


def read_mask_vectors(files: MaskFiles) -> Float32[np.ndarray, "m e"]:
    """Unit vectors of all masks of one view, of all levels.

    Raises:
        SceneError: If the file is not an array [M, e] of finite rows of unit length within 1 %.
    """
    vectors = map_npy(files.vectors)
    if vectors.ndim != 2 or vectors.dtype.kind != "f" or not vectors.shape[1]:
        what = f"array must be floats [M, e], got {vectors.dtype} {list(vectors.shape)}"
        raise SceneError(Fault(str(files.vectors), what))
    with np.errstate(over="ignore"):  # an overflow is infinite, and told below
        vectors = np.asarray(vectors, np.float32)
        norms = np.linalg.norm(vectors, axis=1)
    wrong = np.flatnonzero(~(np.abs(norms - 1) <= 1e-2))
    if len(wrong):
        what = f"rows must be finite and of unit length, got length {norms[wrong[0]]} in row {wrong[0]}"
        raise SceneError(Fault(str(files.vectors), f"{what} and {len(wrong) - 1} others"))
    return vectors / norms[:, None]


def read_mask_map(files: MaskFiles) -> Shaped[np.ndarray, "levels h w"]:
    """All levels as they stand in the file.

    Raises:
        SceneError: If it is not an array [4, H, W] of numbers.
    """
    return np.array(_open_ids(files.ids))


def write_mask_files(
    folder: Path, stem: str, ids: Shaped[np.ndarray, "4 h w"], vectors: Float[np.ndarray, "m e"]
) -> None:
    """Write the two files of one view, float32 both, each complete or not at all.

    Args:
        folder: Where to; it must exist.
        stem: Of the image.
        ids: Mask per pixel at the four levels, -1 for none; ids run on from level to level.
        vectors: A unit vector per id.

    Raises:
        OSError: If a file cannot be written.
    """
    for suffix, array in (("f", vectors), ("s", ids)):
        stream = io.BytesIO()
        np.save(stream, array.astype(np.float32))
        write_atomically(folder / f"{stem}_{suffix}.npy", stream.getvalue())


def read_vocabulary(path: Path) -> Vocabulary:
    """Words and their text vectors, normalised.

    Args:
        path: An npz with `classes` or `names`, and `embeddings`; or a JSON ``{name: vector}``.

    Raises:
        FileNotFoundError: If there is no such file.
        SceneError: If it does not hold one finite vector that is not zero for each of its words.
    """
    if not path.is_file():
        raise FileNotFoundError(f"vocabulary: file must exist, got {path}")
    try:
        names, vectors = _read_npz(path) if path.suffix.lower() == ".npz" else _read_json(path)
        "".join(names).encode()  # half of a surrogate pair cannot be printed or written
    except SceneError:
        raise
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        what = f"content must be {_VOCABULARY}, got {type(error).__name__}: {error}"
        raise SceneError(Fault(str(path), what[:400])) from error
    if vectors.ndim != 2 or len(vectors) != len(names) or not names:
        what = (
            f"embeddings must be [{len(names)}, e], a row for each name, got {list(vectors.shape)}"
        )
        raise SceneError(Fault(str(path), what))
    if len(set(names)) < len(names):
        raise SceneError(Fault(str(path), "names must be unique, got some more than once"))
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not (np.isfinite(norms) & (norms > 0)).all():
        raise SceneError(
            Fault(str(path), "embeddings must be finite and not zero, got rows that are not")
        )
    return Vocabulary(names, torch.from_numpy((vectors / norms).astype(np.float32)))


def write_vocabulary(path: Path, vocabulary: Vocabulary) -> None:
    """Write what `read_vocabulary` reads, whole or not at all.

    Args:
        path: Of an npz; its folder must exist.
        vocabulary: Words and their vectors.

    Raises:
        OSError: If the file cannot be written.
    """
    stream = io.BytesIO()
    np.savez(stream, names=np.array(vocabulary.names), embeddings=vocabulary.vectors.numpy())
    write_atomically(path, stream.getvalue())


def _read_npz(path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    with Archive(path, _VOCABULARY) as archive:
        names = archive.read("classes" if "classes" in archive else "names", "U")
        if names.ndim != 1:
            raise archive.fail(f"names of shape {list(names.shape)}")
        return tuple(names.tolist()), archive.read("embeddings").astype(np.float64)


def _read_json(path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    content = read_json(path, _VOCABULARY)
    return tuple(content), np.array(list(content.values()), np.float64)


def _open_ids(path: Path) -> np.ndarray:
    ids = map_npy(path)
    if ids.ndim != 3 or ids.shape[0] != LEVELS or ids.dtype.kind not in "fiu" or 0 in ids.shape:
        what = f"array must be numbers [{LEVELS}, height, width], got {ids.dtype} {list(ids.shape)}"
        raise SceneError(Fault(str(path), what))
    return ids
