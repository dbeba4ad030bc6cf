"""Cameras to render from: those of the photographs, an orbit, or a file of nerfstudio's or COLMAP's."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.lens import make_lens
from vlgs.data.sparse import Origin, moved, read_cameras
from vlgs.data.untrusted.text import read_json
from vlgs.geometry import camera_center, pose_matrix
from vlgs.opened.files import NamedCamera
from vlgs.opened.run import OpenedRun
from vlgs.types import Camera
from vlgs.values import require_range

MOST_FRAMES = 100_000
LARGEST = 16_384
"""Pixels on a side."""
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""OpenGL camera axes <-> OpenCV's."""


@dataclass(frozen=True)
class CameraPath:
    """Frames in their order."""

    frames: Sequence[NamedCamera]
    fps: float | None = None
    """Of a video; None: the file does not say."""


def cameras_of(run: OpenedRun, which: str, frames: int = 120) -> CameraPath:
    """The cameras that a word or a file names.

    Args:
        run: Whose scene is seen.
        which: ``train``, ``test``, ``orbit``, the name of a photograph, or a file: a camera path of nerfstudio's viewer, a transforms.json,
            or a folder of COLMAP's. Files are in the world of the scene's files, from which `SceneNotes.origin` is subtracted.
        frames: Of an orbit.

    Raises:
        ValueError: If there are no such cameras, or the file is damaged.
        OSError: If the file cannot be read.
    """
    if which in ("train", "test"):
        found = run.cameras(which)
        if not found:
            raise ValueError(
                f"cameras: {which} must have a photograph, got none; there are {len(run.cameras())} others"
            )
        return CameraPath(found)
    if which == "orbit":
        require_range("cameras", 1, MOST_FRAMES, frames=frames)
        return CameraPath(orbit([one.camera for one in run.cameras("train")], frames))
    named = [one for one in run.cameras() if one.name == which]
    if named:
        return CameraPath(named[:1])
    path = Path(which)
    if not which.strip() or not path.exists():
        raise ValueError(
            f"cameras: must be train, test, orbit, a photograph's name or a file, got {which!r}"
        )
    if path.suffix == ".json" and path.is_file():
        content = read_json(path, "a JSON of cameras")
        if isinstance(content, dict) and "camera_path" in content:
            return _camera_path(path, content, run.notes.origin)
    return CameraPath(_reconstruction(path, run.notes.origin))


def orbit(cameras: Sequence[Camera], frames: int) -> list[NamedCamera]:
    """Once around what cameras look at, at their median distance and height, upright as they are on average.

    Args:
        cameras: At least one.
        frames: How many; the first is the nearest to the first camera.
    """
    viewmats = torch.stack([camera.viewmat for camera in cameras]).double()
    centers, axes = camera_center(viewmats), viewmats[:, 2, :3]
    up = upright(viewmats)
    target = focus(centers, axes)
    offsets = centers - target
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    radius = flat.norm(dim=1).median().clamp_min(1e-6 + offsets.norm(dim=1).median() * 0.1)
    first = normalize(flat[0], dim=0) if flat[0].norm() > 1e-9 else _across(up)
    second = torch.linalg.cross(up, first)
    made = []
    for index in range(frames):
        angle = 2 * math.pi * index / frames
        place = math.cos(angle) * first + math.sin(angle) * second
        center = target + radius * place + heights.median() * up
        viewmat = look_at(center, target, up).float()
        first_camera = cameras[0]
        camera = Camera(viewmat, first_camera.K, first_camera.width, first_camera.height)
        made.append(NamedCamera(f"orbit_{index:05d}", "orbit", camera))
    return made


def upright(viewmats: Float[Tensor, "v 4 4"]) -> Float[Tensor, "3"]:
    """The world's up: at right angles to where cameras have their right side, as people hold them level, and near their mean up.

    The mean alone leans where cameras look down from one side.
    """
    rotations = viewmats[:, :3, :3].double()
    right, mean = rotations[:, 0], normalize(-rotations[:, 1].mean(dim=0), dim=0)
    lean = torch.eye(3, dtype=torch.float64) - mean[:, None] * mean
    # Cameras in a row have one right side alone; then their mean decides.
    _, axes = torch.linalg.eigh(right.T @ right + 1e-3 * len(right) * lean)
    return axes[:, 0] * (1 if axes[:, 0] @ mean >= 0 else -1)


def focus(centers: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3"]) -> Float[Tensor, "3"]:
    """The point that the cameras' axes pass nearest to; of parallel ones, a point before them."""
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None]
    matrix = across.sum(dim=0)
    ahead = centers.mean(dim=0) + axes.mean(dim=0) * (centers - centers.mean(dim=0)).norm(
        dim=1
    ).max().clamp_min(1)
    weak = 1e-3 * len(centers) * torch.eye(3, dtype=axes.dtype)
    wanted = (across @ centers[:, :, None]).sum(dim=0)[:, 0]
    return torch.linalg.solve(matrix + weak, wanted + weak @ ahead)


def look_at(
    center: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "4 4"]:
    """World to camera, of a camera at one point that looks at another."""
    ahead = normalize(target - center, dim=0)
    right = torch.linalg.cross(ahead, up)
    right = normalize(right if right.norm() > 1e-6 else _across(ahead), dim=0)
    return pose_matrix(torch.stack([right, torch.linalg.cross(ahead, right), ahead]), center)


def with_size(camera: Camera, width: int, height: int) -> Camera:
    """The same view at another size: the same part of the world from top to bottom, and as much to the sides as fits.

    Raises:
        ValueError: If a side is not 1 to 16384 pixels.
    """
    require_range("cameras", 1, LARGEST, width=width, height=height)
    scale = height / camera.height
    K = camera.K.clone()
    K[:2] *= scale
    K[0, 2] += (width - camera.width * scale) / 2
    return Camera(camera.viewmat, K, width, height)


def _across(axis: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Any direction at right angles to another."""
    other = torch.zeros(3, dtype=axis.dtype)
    other[int(axis.abs().argmin())] = 1
    return normalize(torch.linalg.cross(axis, other), dim=0)


def _camera_path(path: Path, content: Mapping[str, Any], origin: Origin) -> CameraPath:
    """nerfstudio's: camera to world with OpenGL axes, and the vertical field of view in degrees."""
    width = _number(path, content, "render_width", 1, LARGEST)
    height = _number(path, content, "render_height", 1, LARGEST)
    fps = float(_number(path, content, "fps", 1e-3, 1e3)) if "fps" in content else None
    if content.get("camera_type", "perspective") != "perspective":
        raise SceneError(
            Fault(str(path), f"camera_type must be perspective, got {content['camera_type']!r:.80}")
        )
    entries = content["camera_path"]
    if not isinstance(entries, list) or not 1 <= len(entries) <= MOST_FRAMES:
        raise SceneError(
            Fault(str(path), f"camera_path must be a list of 1 to {MOST_FRAMES} cameras")
        )
    frames = []
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise SceneError(Fault(str(path), f"camera {index} must be a mapping"))
        fov = _number(path, entry, "fov", 0.1, 179)
        focal = height / 2 / math.tan(math.radians(fov) / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        pose = _pose(path, f"camera {index}", entry.get("camera_to_world"))
        pose[:3, 3] -= torch.tensor(origin, dtype=torch.float64)
        camera = Camera(torch.linalg.inv(pose @ _FLIP).float(), K, int(width), int(height))
        frames.append(NamedCamera(f"path_{index:05d}", "path", camera))
    return CameraPath(frames, fps)


def _pose(path: Path, who: str, values: Any) -> Float[Tensor, "4 4"]:
    """A camera-to-world matrix of 16 numbers, row by row, or four rows; what scales is taken out."""
    flat = (
        [one for row in values for one in (row if isinstance(row, list) else [row])]
        if isinstance(values, list)
        else []
    )
    sound = len(flat) == 16 and all(
        isinstance(one, int | float) and math.isfinite(one) for one in flat
    )
    pose = torch.tensor(flat, dtype=torch.float64).view(4, 4) if sound else torch.zeros(4, 4)
    length = pose[:3, :3].norm(dim=0)
    turned = pose[:3, :3] / length.clamp_min(1e-12)
    straight = bool((turned.T @ turned - torch.eye(3)).abs().max() < 1e-3) and bool(
        turned.det() > 0
    )
    if not straight:
        raise SceneError(
            Fault(str(path), f"{who}: camera_to_world must be 16 numbers, a rotation and a place")
        )
    pose[:3, :3] = turned
    pose[3] = torch.tensor([0.0, 0, 0, 1])
    return pose


def _number(
    path: Path, content: Mapping[str, Any], key: str, least: int | float, most: int | float
) -> int | float:
    value = content.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not least <= value <= most:
        raise SceneError(
            Fault(str(path), f"{key} must be {least:g} to {most:g}, got {value!r:.80}")
        )
    return value


def _reconstruction(path: Path, origin: Origin) -> list[NamedCamera]:
    """Cameras without distortion, as photographs are read: of COLMAP by name, of other files in their order."""
    model = moved(read_cameras(path), origin)
    file = str(model.file("cameras"))
    lenses = {c.camera_id: make_lens(c, (c.width, c.height), 1.0, file) for c in model.cameras}
    frames = []
    images = list(model.images)
    if model.suffix in (".bin", ".txt"):  # whose order is that of registration or of none
        images.sort(key=lambda image: image.name)
    names = _distinct([image.name for image in images])
    for image, name in zip(images, names, strict=True):
        lens = lenses[image.camera_id]
        K = torch.from_numpy(lens.intrinsics())
        camera = Camera(image.viewmat().float(), K.float(), *lens.size)
        frames.append(NamedCamera(name, "file", camera))
    if not frames:
        raise ValueError(f"cameras: {path} must have an image, got none")
    return frames


def _distinct(images: Sequence[str]) -> list[str]:
    """Names for pictures of images: their stems; with folder and suffix where two have the same stem.

    Example:
        >>> _distinct(["left/1.jpg", "right/1.jpg", "right/2.jpg"])
        ['left_1.jpg', 'right_1.jpg', '2']
    """
    stems = Counter(Path(image).stem for image in images)
    return [
        stem if stems[stem := Path(image).stem] == 1 else image.replace("/", "_")
        for image in images
    ]
