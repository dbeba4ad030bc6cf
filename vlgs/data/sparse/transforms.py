"""nerfstudio's and instant-ngp's ``transforms.json`` as a `SparseModel`, and back.

Camera-to-world matrices with OpenGL axes (x right, y up, z back); intrinsics for all frames or per frame. What nerfstudio applied to
the original world (``applied_transform``, ``applied_scale``) is undone, so that a COLMAP scene and its transforms.json are one scene.
instant-ngp records no such thing: its world stays as it is. Points come from ``ply_file_path``, if there is one.
"""

import glob
import io
import json
import math
from collections import ChainMap
from collections.abc import Mapping
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from plyfile import PlyData, PlyElement

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.sparse.model import SparseCamera, SparseImage, SparseModel
from vlgs.data.sparse.origin import AT_HOME, origin_of
from vlgs.data.untrusted.pictures import picture
from vlgs.data.untrusted.ply import read_vertices
from vlgs.data.untrusted.text import read_json
from vlgs.files import write_atomically
from vlgs.geometry import rotmat_to_quat

FILE = "transforms.json"
_POINTS = "sparse_pc.ply"
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL camera axes <-> OpenCV's."""
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
_CHANNELS = ("red", "green", "blue")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_MOST = 1e9
_LONGEST_PATH = 4096


def read_transforms(path: Path) -> SparseModel:
    """Cameras, poses and points of a file; image names are relative to the folder that holds all images.

    Sizes that are missing come from the image files, a missing principal point is the middle, a missing focal length comes from
    ``camera_angle_x`` (radians across the width).

    Raises:
        SceneError: Names the frame and the key that is wrong.
    """
    content = read_json(path, "a JSON with frames")
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        what = "content must be a JSON with frames, a list of mappings, got none"
        raise SceneError(Fault(str(path), what))
    unturn, scale = _applied(path, content)
    names = [_name(path, number, frame) for number, frame in enumerate(frames)]
    shared = _shared_folder(names)
    cameras: dict[tuple[Any, ...], SparseCamera] = {}
    images = []
    for number, (frame, name) in enumerate(zip(frames, names, strict=True)):
        where = f"frame {number}"
        lens = _lens(path, where, ChainMap(frame, content), path.parent / name)
        camera = cameras.setdefault(lens, SparseCamera(len(cameras) + 1, *lens))
        pose = _matrix(path, where, frame.get("transform_matrix"))
        pose[:3, 3] /= scale
        viewmat = np.linalg.inv(unturn @ pose @ _FLIP)
        quat = rotmat_to_quat(torch.from_numpy(viewmat[:3, :3]))
        images.append(
            SparseImage(
                number + 1,
                camera.camera_id,
                str(name.relative_to(shared)),
                tuple(quat.tolist()),
                tuple(viewmat[:3, 3].tolist()),
                observations=-1,
            )
        )
    points, colors = _read_points(path, content)
    points = points / scale @ unturn[:3, :3].T + unturn[:3, 3]
    ids = np.arange(1, len(points) + 1)
    return SparseModel(
        path.parent, FILE, tuple(cameras.values()), tuple(images), ids, points, colors
    )


def write_transforms(path: Path, model: SparseModel, images: str = "images") -> None:
    """Write nerfstudio's file, and the points beside it as ``sparse_pc.ply``: both, or neither.

    Args:
        path: The JSON; its folder must exist.
        model: Its cameras must be perspective or OPENCV_FISHEYE.
        images: Folder of the photographs, relative to the file's.

    Raises:
        ValueError: If a camera's model has no place in the format, or there are points beside the file that are not its own.
        OSError: If a file cannot be written.
    """
    points = path.with_name(_POINTS)
    known = points.exists() or points.is_symlink()
    if len(model.points) and known and not _names_points(path):
        raise ValueError(
            f"transforms {path}: {_POINTS} beside it must not be there, got one that is not its own; a folder of its own will do"
        )
    lenses = {camera.camera_id: _written_lens(path, camera) for camera in model.cameras}
    frames = []
    for image in model.images:
        frame: dict[str, Any] = {
            "file_path": str(PurePosixPath(images) / image.name),
            "transform_matrix": (np.linalg.inv(image.viewmat().numpy()) @ _FLIP).tolist(),
        }
        frames.append(frame if len(lenses) == 1 else frame | lenses[image.camera_id])
    content: dict[str, Any] = dict(next(iter(lenses.values()))) if len(lenses) == 1 else {}
    if len(model.points):
        write_atomically(points, _encode_points(model))
        content["ply_file_path"] = _POINTS
    content["frames"] = frames
    try:
        write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
    except OSError:
        if len(model.points) and not known:
            points.unlink()
        raise


def _encode_points(model: SparseModel) -> bytes:
    """The points as a PLY: in float32 as elsewhere, in doubles where that is too coarse for the scene."""
    far = bool(model.images) and origin_of(model) != AT_HOME
    columns = [(axis, "<f8" if far else "<f4") for axis in "xyz"]
    rows = np.empty(len(model.points), columns + [(channel, "u1") for channel in _CHANNELS])
    for column, axis in enumerate("xyz"):
        rows[axis] = model.points[:, column]
    for column, channel in enumerate(_CHANNELS):
        rows[channel] = model.point_colors[:, column]
    stream = io.BytesIO()
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(stream)
    return stream.getvalue()


def _names_points(path: Path) -> bool:
    """Whether a file that is there says that the points beside it are its own."""
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get("ply_file_path") == _POINTS


def _name(path: Path, number: int, frame: Mapping[str, Any]) -> PurePosixPath:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name.strip() or len(name) > _LONGEST_PATH or "\0" in name:
        what = f"file_path must be the path of an image, got {str(name)[:80]!r}"
        raise SceneError(Fault(str(path), what, where=f"frame {number}"))
    return PurePosixPath(name.replace("\\", "/"))


def _shared_folder(names: list[PurePosixPath]) -> PurePosixPath:
    """Deepest folder that holds them all."""
    folders = [name.parent.parts for name in names]
    # What the first and the last in order share, all share.
    first, last = (min(folders), max(folders)) if folders else ((), ())
    shared = takewhile(lambda pair: pair[0] == pair[1], zip(first, last, strict=False))
    return PurePosixPath(*(part for part, _ in shared))


def _applied(path: Path, content: Mapping[str, Any]) -> tuple[Float64[np.ndarray, "4 4"], float]:
    """What undoes the transform that nerfstudio applied, and the scale that it applied after it."""
    applied = np.eye(4)
    if "applied_transform" in content:
        applied = _matrix(path, "applied_transform", content["applied_transform"])
    scale = _number(path, "applied_scale", content.get("applied_scale", 1.0), least=1e-9)
    return np.linalg.inv(applied), scale


def _matrix(path: Path, where: str, value: Any) -> Float64[np.ndarray, "4 4"]:
    """A rotation and a translation: 3 x 4, or 4 x 4 with the last row that it must have."""
    try:
        rows = np.array(value, np.float64)
    except (ValueError, TypeError):
        rows = np.zeros(0)
    what = "matrix must be a rotation and a translation, 3 x 4 or 4 x 4"
    if rows.shape not in ((3, 4), (4, 4)) or not (np.abs(rows) <= _MOST).all():
        raise SceneError(Fault(str(path), f"{what}, got {str(value)[:80]}", where=where))
    matrix = np.eye(4)
    matrix[:3] = rows[:3]
    turn = matrix[:3, :3]
    if not is_rotation(turn):
        raise SceneError(Fault(str(path), f"{what}, got axes {turn.tolist()}", where=where))
    return matrix


def is_rotation(axes: Float64[np.ndarray, "3 3"]) -> bool:
    """Whether axes are right-handed, of unit length and at right angles, to a thousandth."""
    with np.errstate(over="ignore", invalid="ignore"):  # of axes beyond any length
        off = np.abs(axes @ axes.T - np.eye(3)).max()
    return bool(off <= 1e-3 and np.linalg.det(axes) > 0)


def _lens(
    path: Path, where: str, keys: Mapping[str, Any], image: Path
) -> tuple[str, int, int, tuple[float, ...]]:
    """Model, width, height and parameters in COLMAP's terms."""

    def number(key: str, default: float | None = None, least: float = -_MOST) -> float:
        value = keys.get(key)
        return _number(path, f"{where}, {key}", default if value is None else value, least)

    if keys.get("w") is None or keys.get("h") is None:
        width, height = _image_size(path, where, image)
    else:
        width, height = int(number("w", least=1.0)), int(number("h", least=1.0))
    if keys.get("fl_x") is None and keys.get("camera_angle_x") is not None:
        focal = width / 2 / math.tan(number("camera_angle_x", least=1e-3) / 2)
    else:
        focal = number("fl_x", least=1e-3)
    if keys.get("fl_y") is None and keys.get("camera_angle_y") is not None:
        other = height / 2 / math.tan(number("camera_angle_y", least=1e-3) / 2)
    else:
        other = number("fl_y", focal, least=1e-3)
    pinhole = (focal, other, number("cx", width / 2), number("cy", height / 2))
    k1, k2, k3, k4, p1, p2 = (number(key, 0.0) for key in _DISTORTION)
    model = keys.get("camera_model", "OPENCV_FISHEYE" if keys.get("is_fisheye") else "OPENCV")
    if model == "OPENCV_FISHEYE":
        return model, width, height, (*pinhole, k1, k2, k3, k4)
    if model not in _PERSPECTIVE or k4:
        known = ", ".join((*_PERSPECTIVE, "OPENCV_FISHEYE"))
        got = f"{model} with k4 = {k4}" if model in _PERSPECTIVE else repr(model)
        what = f"camera_model must be one of {known}, without k4 unless fisheye, got {got}"
        raise SceneError(Fault(str(path), what, where=where))
    if k3:
        return "FULL_OPENCV", width, height, (*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    if any((k1, k2, p1, p2)):
        return "OPENCV", width, height, (*pinhole, k1, k2, p1, p2)
    return "PINHOLE", width, height, pinhole


def _number(path: Path, where: str, value: Any, least: float = -_MOST) -> float:
    if type(value) not in (int, float) or not least <= value <= _MOST:
        what = f"value must be a number of {least:g} to {_MOST:g}, got {value!r}"
        raise SceneError(Fault(str(path), what, where=where))
    return float(value)


def _image_size(path: Path, where: str, image: Path) -> tuple[int, int]:
    try:
        named = f"{glob.escape(image.name)}.*"
        found = image if image.is_file() else next(iter(sorted(image.parent.glob(named))), image)
        with picture(found) as opened:
            return opened.size
    except (ValueError, OSError) as error:
        what = f"w and h must be given or {image} must be an image, got {error}"
        raise SceneError(Fault(str(path), what, where=where)) from error


def _read_points(
    path: Path, content: Mapping[str, Any]
) -> tuple[Float64[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    name = content.get("ply_file_path")
    if name is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    file = path.parent / str(name)
    expected = "ply_file_path must be a PLY with x y z red green blue"
    try:
        vertices = read_vertices(file)
        colors = _as_bytes(file, np.stack([vertices[name] for name in _CHANNELS], axis=1))
        points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except (OSError, KeyError) as error:
        raise SceneError(
            Fault(str(file), f"{expected}, got {type(error).__name__}: {error}")
        ) from error
    return points, colors


def _as_bytes(file: Path, colors: np.ndarray) -> UInt8[np.ndarray, "p 3"]:
    """Colours of 0 to 255, of a file that has them so, as floats of 0 to 1 or in 16 bits."""
    if colors.dtype == np.uint8:
        return colors
    kind, size = colors.dtype.kind, colors.dtype.itemsize
    values = np.where(np.isnan(colors), 0, colors).astype(np.float64)  # NaN is no colour
    low, high = values.min(initial=0.0), values.max(initial=0.0)
    scale = 1.0
    if kind == "f" and high < 1.001:  # of 255 all would be black; some programs round to above 1
        scale = 255.0
    elif (kind, size) == ("u", 2) and high > 255:  # else of 65535 all would be black
        scale = 1 / 257
    if low < -0.5 / scale or high >= 255.5 / scale:
        what = "colours must be 0 to 255, 0 to 1 as floats or 0 to 65535 as ushort of a binary file"
        raise SceneError(Fault(str(file), f"{what}, got {low:g} to {high:g}"))
    return np.rint(values * scale).astype(np.uint8)


def _written_lens(path: Path, camera: SparseCamera) -> dict[str, Any]:
    keys = {
        "SIMPLE_PINHOLE": (),
        "PINHOLE": (),
        "SIMPLE_RADIAL": ("k1",),
        "RADIAL": ("k1", "k2"),
        "OPENCV": ("k1", "k2", "p1", "p2"),
        "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
        "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    }.get(camera.model)
    bent = camera.params[len(camera.params) - len(keys or ()) :]
    if keys is None or (camera.model == "FULL_OPENCV" and any(bent[5:])):
        what = "cameras must be perspective with k1, k2, k3, p1, p2, or OPENCV_FISHEYE"
        raise ValueError(f"transforms {path}: {what}, got {camera.model} {camera.params}")
    fx, fy, cx, cy = camera.intrinsics()
    fisheye = camera.model == "OPENCV_FISHEYE"
    named = {key: value for key, value in zip(keys, bent, strict=True) if key in _DISTORTION}
    model = "OPENCV_FISHEYE" if fisheye else "OPENCV" if named else "PINHOLE"
    sizes = {"w": camera.width, "h": camera.height}
    focal = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    return {"camera_model": model, **sizes, **focal, **named}
