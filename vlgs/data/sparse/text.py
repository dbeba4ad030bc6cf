"""COLMAP's ``.txt`` files ("Output Format" in its documentation)."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, UInt8

from vlgs.data.diagnostics import Fault, SceneError, listing
from vlgs.data.sparse.model import PARAMETERS, SparseCamera, SparseImage
from vlgs.data.untrusted.text import read_text

T = TypeVar("T")


def read_cameras(path: Path) -> tuple[SparseCamera, ...]:
    """All cameras of a ``cameras.txt``: ``id model width height parameters...`` a line.

    Raises:
        SceneError: With the line that does not read so.
    """

    def camera(words: list[str]) -> SparseCamera:
        if len(words) < 4:
            raise ValueError(f"camera must be at least 4 words, got {len(words)}")
        model = words[1]
        if model not in PARAMETERS:
            raise ValueError(
                f"camera model must be one of {listing(PARAMETERS, 99)}, got {model[:40]}"
            )
        if len(words) != 4 + PARAMETERS[model]:
            expected = f"{PARAMETERS[model]} parameters for {model}"
            raise ValueError(f"camera must have {expected}, got {len(words) - 4}")
        params = tuple(map(float, words[4:]))
        return SparseCamera(_whole(words[0]), model, _whole(words[2]), _whole(words[3]), params)

    return tuple(_parse(path, number, line, camera) for number, line in _records(path))


def read_images(path: Path) -> tuple[SparseImage, ...]:
    """All images of an ``images.txt``: ``id qw qx qy qz tx ty tz camera name`` and a line of its 2D points.

    Raises:
        SceneError: With the line that does not read so.
    """
    lines = _lines(path)
    images, at = [], 0
    while at < len(lines):
        if _is_blank(lines[at]):
            at += 1
            continue
        # The second line may well be empty, so it is taken as it comes.
        points = lines[at + 1] if at + 1 < len(lines) else None
        if points is None:
            raise SceneError(
                Fault(
                    str(path),
                    "image must be followed by a line of 2D points, got the end",
                    where=f"line {at + 1}",
                )
            )
        observations = _parse(path, at + 2, points, _count_seen)
        images.append(
            _parse(
                path,
                at + 1,
                lines[at],
                lambda words, line=lines[at], n=observations: _image(words, line, n),
            )
        )
        at += 2
    return tuple(images)


def read_points(
    path: Path,
) -> tuple[np.ndarray, Float64[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Ids [p], positions in world units and colours of a ``points3D.txt``: ``id x y z r g b error track...``.

    Raises:
        SceneError: With the line that does not read so.
    """

    def point(words: list[str]) -> tuple[int, list[float], list[int]]:
        if len(words) < 8 or len(words) % 2:
            raise ValueError(f"point must be 8 words and pairs of a track, got {len(words)} words")
        rgb = [_whole(word, 255) for word in words[4:7]]
        return _whole(words[0]), list(map(float, words[1:4])), rgb

    points = [_parse(path, number, line, point) for number, line in _records(path)]
    ids = np.array([p[0] for p in points], np.uint64)
    positions = np.array([p[1] for p in points], np.float64).reshape(-1, 3)
    return ids, positions, np.array([p[2] for p in points], np.uint8).reshape(-1, 3)


def _image(words: list[str], line: str, observations: int) -> SparseImage:
    if len(words) < 10:
        raise ValueError(f"image must be 10 words, got {len(words)}")
    pose = tuple(map(float, words[1:8]))
    name = line.strip().split(maxsplit=9)[9]  # blanks within it as they are
    return SparseImage(_whole(words[0]), _whole(words[8]), name, pose[:4], pose[4:], observations)


def _count_seen(words: list[str]) -> int:
    if len(words) % 3:
        raise ValueError(f"2D points must be triples x y id, got {len(words)} words")
    return sum(int(word) != -1 for word in words[2::3])


def _whole(word: str, largest: int = 2**64 - 1) -> int:
    value = int(word)
    if not 0 <= value <= largest:
        raise ValueError(f"number must be 0 to {largest}, got {value}")
    return value


def _parse(path: Path, number: int, line: str, read: Callable[[list[str]], T]) -> T:
    try:
        return read(line.split())
    except ValueError as error:
        raise SceneError(Fault(str(path), str(error), where=f"line {number}")) from error


def _records(path: Path) -> Iterator[tuple[int, str]]:
    return ((i, line) for i, line in enumerate(_lines(path), start=1) if not _is_blank(line))


def _lines(path: Path) -> list[str]:
    # Not splitlines: it takes characters for ends that names of files may have, such as U+2028.
    return read_text(path).removesuffix("\n").split("\n")


def _is_blank(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith("#")
