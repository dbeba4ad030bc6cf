"""A COLMAP reconstruction as plain values, and what must hold for it to be used."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Set
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from torch import Tensor

from vlgs.data.diagnostics import Fault, listing, warning
from vlgs.geometry import quat_to_rotmat

CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Model id of the binary files -> name of the text files and number of parameters."""

PARAMETERS = dict(CAMERA_MODELS.values())
"""Model name -> number of parameters."""

ONE_FOCAL_LENGTH = frozenset(
    {
        "SIMPLE_PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
        "SIMPLE_DIVISION",
        "SIMPLE_FISHEYE",
    }
)
"""Models whose parameters begin ``f, cx, cy``; those of the other perspective ones begin ``fx, fy, cx, cy``."""

_LARGEST = float(np.finfo(np.float32).max)
_LARGEST_SIDE = 1 << 17
_LONGEST_NAME = 255
"""Bytes of a file's or folder's name, on any system in use."""


@dataclass(frozen=True)
class SparseCamera:
    """One camera; see https://colmap.github.io/cameras.html for the models."""

    camera_id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def intrinsics(self) -> tuple[float, float, float, float]:
        """``fx, fy, cx, cy`` in pixels."""
        if self.model in ONE_FOCAL_LENGTH:
            f, cx, cy = self.params[:3]
            return f, f, cx, cy
        fx, fy, cx, cy = self.params[:4]
        return fx, fy, cx, cy


@dataclass(frozen=True)
class SparseImage:
    """One registered photograph."""

    image_id: int
    camera_id: int
    name: str
    """Path below the image folder, with ``/``."""
    quat: tuple[float, ...]
    """World-to-camera rotation (w, x, y, z)."""
    translation: tuple[float, ...]
    observations: int
    """Sparse points that it sees; -1 where the format does not say."""

    def viewmat(self) -> Float64[Tensor, "4 4"]:
        """World to camera."""
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = quat_to_rotmat(torch.tensor(self.quat, dtype=torch.float64))
        viewmat[:3, 3] = torch.tensor(self.translation, dtype=torch.float64)
        return viewmat


@dataclass(frozen=True)
class SparseModel:
    """The content of the three files of a reconstruction, in their order and not yet checked."""

    folder: Path
    suffix: str
    """``.bin`` or ``.txt``; the name of the one file of another format."""
    cameras: tuple[SparseCamera, ...]
    images: tuple[SparseImage, ...]
    point_ids: np.ndarray
    points: Float64[np.ndarray, "p 3"]
    """World units."""
    point_colors: UInt8[np.ndarray, "p 3"]

    def file(self, stem: str) -> Path:
        """Path of ``cameras``, ``images`` or ``points3D``."""
        return self.folder / (f"{stem}{self.suffix}" if self.suffix[0] == "." else self.suffix)


def model_faults(model: SparseModel) -> Iterator[Fault]:
    """Everything about a reconstruction that contradicts itself or the format."""
    cameras, images = str(model.file("cameras")), str(model.file("images"))
    yield from _repeated(cameras, "camera ids", (c.camera_id for c in model.cameras))
    for camera in model.cameras:
        yield from camera_faults(camera, cameras)
    if not model.images:
        yield Fault(images, "registered images must be at least 1, got 0", "run COLMAP again")
    yield from _repeated(images, "image ids", (i.image_id for i in model.images))
    yield from _repeated(images, "image names", (i.name for i in model.images))
    known = {camera.camera_id for camera in model.cameras}
    for image in model.images:
        yield from image_faults(image, known, images)
        if not image.observations and len(model.points):
            what = f"image {image.name!r}: sparse points seen must be at least 1, got 0"
            yield warning(images, what, "its pose rests on nothing; take it out")
    yield from _point_faults(model)


def camera_faults(camera: SparseCamera, file: str) -> Iterator[Fault]:
    """What keeps one camera from being used."""
    who = f"camera {camera.camera_id}"
    if not all(0 < side <= _LARGEST_SIDE for side in (camera.width, camera.height)):
        size = f"{camera.width} x {camera.height}"
        yield Fault(file, f"{who}: size must be 1 to {_LARGEST_SIDE} pixels a side, got {size}")
    if not _finite(camera.params):
        yield Fault(file, f"{who}: parameters must be finite, got {camera.params}")
    elif camera.model != "EQUIRECTANGULAR" and min(camera.intrinsics()[:2]) <= 0:
        yield Fault(file, f"{who}: focal length must be positive, got {camera.params[:2]}")


def image_faults(image: SparseImage, cameras: Set[int], file: str) -> Iterator[Fault]:
    """What keeps one image from being used, given the ids of the cameras that there are."""
    who = f"image {image.name!r}"
    if not _stays_below(image.name):
        yield Fault(file, f"{who}: name must be a path below the image folder, got {image.name!r}")
    if image.camera_id not in cameras:
        # Of the first few: thousands of images that are at fault list them each.
        expected = f"one of {listing(map(str, islice(cameras, 10)))}"
        yield Fault(file, f"{who}: camera id must be {expected}, got {image.camera_id}")
    if not _finite(image.quat + image.translation):
        yield Fault(file, f"{who}: pose must be finite, got {image.quat} {image.translation}")
    elif abs(sum(q * q for q in image.quat) - 1) > 2e-2:
        yield Fault(file, f"{who}: rotation must be a unit quaternion, got {image.quat}")


def _point_faults(model: SparseModel) -> Iterator[Fault]:
    file = model.file("points3D")
    ids, counts = np.unique(model.point_ids, return_counts=True)
    if (counts > 1).any():
        yield Fault(
            str(file),
            f"point ids must be unique, got {listing(map(str, ids[counts > 1]))} more than once",
        )
    wrong = np.flatnonzero(~(np.abs(model.points) <= _LARGEST).all(axis=1))
    if len(wrong):
        first = f"{model.points[wrong[0]].tolist()} for point {model.point_ids[wrong[0]]}"
        yield Fault(str(file), f"positions must be finite, got {first} and {len(wrong) - 1} others")
    if len(model.points) < 100:
        what = f"sparse points should be in the thousands, got {len(model.points)}"
        advice = "Gaussians start there: reconstruct again with more features or more images"
        yield warning(file, what, advice)


def _repeated(file: str, what: str, values: Iterable[int | str]) -> Iterator[Fault]:
    repeated = [str(value) for value, count in Counter(values).items() if count > 1]
    if repeated:
        yield Fault(file, f"{what} must be unique, got {listing(repeated)} more than once")


def _finite(values: tuple[float, ...]) -> bool:
    """Whether all are finite also in float32, which is what a scene is held in."""
    return all(abs(value) <= _LARGEST for value in values)


def _stays_below(name: str) -> bool:
    """Whether a name from a file can be joined to a folder without leaving it, on any system."""
    drive_or_control = re.match(r"[A-Za-z]:|.*[\x00-\x1f\x7f]", name, re.DOTALL)
    path = PurePosixPath(name.replace("\\", "/"))
    fits = all(len(part.encode()) <= _LONGEST_NAME for part in path.parts) and len(name) < 4096
    outside = drive_or_control or path.is_absolute() or ".." in path.parts
    return bool(path.name) and fits and not outside
