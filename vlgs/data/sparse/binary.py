"""COLMAP's ``.bin`` files. Every count in them is checked against the size of the file first.

COLMAP's own reader returns garbage for a truncated ``cameras.bin``, and a damaged count makes it use up all memory. This one
reads the file to its last byte or raises an error, and needs no more memory than the file has bytes.
"""

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from vlgs.data.diagnostics import Fault, SceneError, listing
from vlgs.data.sparse.model import CAMERA_MODELS, SparseCamera, SparseImage
from vlgs.data.untrusted import read_bytes

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK_ELEMENT = 8
_LONGEST_NAME = 4096


class _Reader:
    """A position in a file that cannot move past its end."""

    def __init__(self, path: Path):
        self.path = path
        self.data = read_bytes(path)
        self.at = 0

    def fail(self, what: str, at: int | None = None) -> SceneError:
        where = f"byte {self.at if at is None else at}"
        advice = "the file is truncated or damaged: copy it again or run COLMAP again"
        return SceneError(Fault(str(self.path), what, advice, where))

    def skip(self, size: int, what: str) -> int:
        """Move on by `size` bytes and return where they begin."""
        start, left = self.at, len(self.data) - self.at
        if size > left:
            raise self.fail(f"{what} must be {size} bytes, got {left} before the end of the file")
        self.at += size
        return start

    def take(self, layout: struct.Struct, what: str) -> tuple:
        return layout.unpack_from(self.data, self.skip(layout.size, what))

    def count(self, what: str, record_size: int) -> int:
        """A record count that the rest of the file has room for."""
        start = self.at
        (count,) = self.take(_COUNT, f"number of {what}")
        room = (len(self.data) - self.at) // record_size
        if count > room:
            raise self.fail(
                f"number of {what} must be at most {room} for a file of {len(self.data)} bytes, got {count}",
                start,
            )
        return count

    def text(self, what: str) -> str:
        """A NUL-terminated name in UTF-8."""
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME)
        if end < 0:
            raise self.fail(
                f"{what} must be at most {_LONGEST_NAME} bytes and end in NUL, got no NUL"
            )
        raw = self.data[self.at : end]
        try:
            name = raw.decode()
        except UnicodeDecodeError as error:
            raise self.fail(f"{what} must be UTF-8, got {raw[:80]!r}") from error
        self.at = end + 1
        return name

    def finish(self) -> None:
        if left := len(self.data) - self.at:
            raise self.fail(f"bytes after the last record must be 0, got {left}")


def read_cameras(path: Path) -> tuple[SparseCamera, ...]:
    """All cameras of a ``cameras.bin``.

    Raises:
        SceneError: If the file is not exactly what its counts say, or a camera model is unknown.
    """
    reader = _Reader(path)
    cameras = []
    for _ in range(reader.count("cameras", _CAMERA.size)):
        start = reader.at
        camera_id, model_id, width, height = reader.take(_CAMERA, "camera")
        if model_id not in CAMERA_MODELS:
            known = listing((f"{i} {name}" for i, (name, _) in CAMERA_MODELS.items()), limit=99)
            raise reader.fail(f"camera model id must be one of {known}, got {model_id}", start + 4)
        model, n_params = CAMERA_MODELS[model_id]
        params = reader.take(struct.Struct(f"<{n_params}d"), f"parameters of camera {camera_id}")
        cameras.append(SparseCamera(camera_id, model, width, height, params))
    reader.finish()
    return tuple(cameras)


def read_images(path: Path) -> tuple[SparseImage, ...]:
    """All images of an ``images.bin``.

    Raises:
        SceneError: If the file is not exactly what its counts say.
    """
    reader = _Reader(path)
    images = []
    for _ in range(reader.count("images", _IMAGE.size + 1 + _COUNT.size)):
        image_id, *pose, camera_id = reader.take(_IMAGE, "image")
        name = reader.text(f"name of image {image_id}")
        count = reader.count(f"2D points of image {name!r}", _POINT2D.itemsize)
        start = reader.skip(count * _POINT2D.itemsize, f"2D points of image {name!r}")
        seen = np.frombuffer(reader.data, _POINT2D, count, start)["point"]
        observations = int((seen != -1).sum())
        images.append(
            SparseImage(image_id, camera_id, name, tuple(pose[:4]), tuple(pose[4:]), observations)
        )
    reader.finish()
    return tuple(images)


def read_points(
    path: Path,
) -> tuple[np.ndarray, Float64[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Ids [p], positions in world units and colours of a ``points3D.bin``.

    Raises:
        SceneError: If the file is not exactly what its counts say.
    """
    reader = _Reader(path)
    count = reader.count("points", _POINT.itemsize + _COUNT.size)
    starts = np.empty(count, np.int64)
    for i in range(count):
        starts[i] = reader.skip(_POINT.itemsize, "point")
        track = reader.count("track elements", _TRACK_ELEMENT)
        reader.skip(track * _TRACK_ELEMENT, "track")
    reader.finish()
    raw = np.frombuffer(reader.data, np.uint8)
    # In blocks, so that the index of the gather does not take eight times the file.
    blocks = [
        raw[starts[i : i + 65536, None] + np.arange(_POINT.itemsize)].reshape(-1).view(_POINT)
        for i in range(0, count, 65536)
    ]
    points = np.concatenate(blocks) if blocks else np.empty(0, _POINT)
    return points["id"], np.ascontiguousarray(points["xyz"]), np.ascontiguousarray(points["rgb"])
