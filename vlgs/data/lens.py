"""From a COLMAP camera to a pinhole one: where in the image file each output pixel lies.

One mapping serves photographs (bilinear, then area averages), label maps and mask maps (nearest), so that they stay aligned.
Lenses with distortion are undistorted by COLMAP's own formulas; `import_pycolmap` is the one place that imports it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from PIL import Image
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.sparse.model import SparseCamera

_BLOCK = 1 << 20
"""Pixels whose positions are computed at a time, so that a 50 megapixel image does not take gigabytes."""


def import_pycolmap() -> ModuleType:
    """Import pycolmap, which is slow to load and therefore left until a lens needs it.

    Pillow comes first, always (this module imports it at the top): pycolmap 4.2.1 imported before Pillow 13 corrupts the
    heap once a PNG is written.
    """
    import pycolmap

    return pycolmap


@dataclass(frozen=True)
class Lens:
    """How images of one camera and one file size become pinhole images."""

    pinhole: SparseCamera
    """Free of distortion, at the resolution of the file."""
    distorted: SparseCamera | None
    """What took the picture, at the resolution of the file; None if that was a pinhole already."""
    file_size: tuple[int, int]
    """Width and height of the image file in pixels."""
    size: tuple[int, int]
    """Width and height of the output in pixels."""

    def intrinsics(self) -> Float64[np.ndarray, "3 3"]:
        """K of the output image."""
        fx, fy, cx, cy = self.pinhole.intrinsics()
        sx, sy = self._scale()
        return np.array([[fx / sx, 0, cx / sx], [0, fy / sy, cy / sy], [0, 0, 1]])

    def to_file(self, xy: Float64[np.ndarray, "p 2"]) -> Float64[np.ndarray, "p 2"]:
        """Map positions in the output to positions in the file, both in pixels; NaN where the lens sees nothing."""
        xy = xy * self._scale()
        if self.distorted is None:
            return xy
        fx, fy, cx, cy = self.pinhole.intrinsics()
        rays = np.ones((len(xy), 3))
        rays[:, :2] = (xy - [cx, cy]) / [fx, fy]
        return _pycolmap_camera(self.distorted).img_from_cam(rays)

    def from_file(self, xy: Float64[np.ndarray, "p 2"]) -> Float64[np.ndarray, "p 2"]:
        """Inverse of `to_file`."""
        if self.distorted is not None:
            fx, fy, cx, cy = self.pinhole.intrinsics()
            xy = _pycolmap_camera(self.distorted).cam_from_img(xy) * [fx, fy] + [cx, cy]
        return xy / self._scale()

    def in_file(self, xy: Float64[np.ndarray, "p 2"]) -> Bool[np.ndarray, " p"]:
        """Whether the file has pixels at these output positions."""
        return _inside(self.to_file(xy), self.file_size)

    def _scale(self) -> tuple[float, float]:
        """Pixels at the file's resolution per output pixel."""
        width, height = self.size
        return self.pinhole.width / width, self.pinhole.height / height


def make_lens(camera: SparseCamera, file_size: tuple[int, int], resize: float, source: str) -> Lens:
    """The lens of one camera for image files of one size.

    Args:
        camera: As COLMAP has it.
        file_size: Width and height of the image file, which may be a scaled copy of what the camera took.
        resize: Output size as a fraction of the undistorted file's, in (0, 1].
        source: File the camera was read from, for the error message.

    Raises:
        SceneError: If the camera's model cannot be undistorted, or its parameters describe no lens.
    """
    if camera.model in ("PINHOLE", "SIMPLE_PINHOLE"):
        distorted, pinhole = None, _scaled_pinhole(camera, file_size)
    else:
        distorted, pinhole = _undistort(camera, file_size, source)
    size = tuple(max(1, round(side * resize)) for side in (pinhole.width, pinhole.height))
    lens = Lens(pinhole, distorted, file_size, (size[0], size[1]))
    if distorted is not None:
        _require_invertible(lens, camera, source)
    return lens


def covers_all(lens: Lens) -> bool:
    """Whether every output pixel lies inside the file.

    The mapping is continuous, so the pixels along the border decide for those within.
    """
    if lens.distorted is None:
        return True
    return bool(lens.in_file(_border(lens.size, margin=0.5)).all())


def nearest_pixels(lens: Lens, map_size: tuple[int, int]) -> Int64[Tensor, "h w"]:
    """For each output pixel the row-major index of the nearest pixel of a map that covers the file; -1 outside.

    Args:
        lens: The mapping.
        map_size: Width and height of the map; it may be coarser or finer than the file.
    """
    ratio = np.divide(map_size, lens.file_size)
    index = np.empty((lens.size[1], lens.size[0]), np.int64)
    for rows, xy in _pixel_centers(lens.size):
        at = lens.to_file(xy) * ratio
        inside = _inside(at, map_size)
        column, row = np.where(inside[:, None], at, 0).astype(np.int64).T
        index[rows] = np.where(inside, row * map_size[0] + column, -1).reshape(-1, lens.size[0])
    return torch.from_numpy(index)


def sampling_grid(lens: Lens) -> Float32[Tensor, "h w 2"]:
    """Position in the file of every pixel of the undistorted image at full resolution, in [-1, 1] across the file."""
    full = replace(lens, size=(lens.pinhole.width, lens.pinhole.height))
    grid = np.empty((full.size[1], full.size[0], 2), np.float32)
    for rows, xy in _pixel_centers(full.size):
        at = np.nan_to_num(full.to_file(xy), nan=-1.0)
        grid[rows] = (2 * at / full.file_size - 1).reshape(-1, full.size[0], 2)
    return torch.from_numpy(grid)


def undistort_pixels(
    pixels: UInt8[Tensor, "fh fw 3"], grid: Float32[Tensor, "h w 2"]
) -> UInt8[Tensor, "h w 3"]:
    """Bilinear samples of an image file at `sampling_grid`; positions outside take the nearest border pixel."""
    planes = pixels.permute(2, 0, 1)[None].float()
    out = F.grid_sample(
        planes, grid[None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return out[0].permute(1, 2, 0).round().to(torch.uint8).contiguous()


def shrink_pixels(
    pixels: UInt8[Tensor, "fh fw 3"], size: tuple[int, int]
) -> UInt8[Tensor, "h w 3"]:
    """The image at a smaller width and height, each pixel the average of the area it covers."""
    if (pixels.shape[1], pixels.shape[0]) == size:
        return pixels
    small = Image.fromarray(pixels.numpy()).resize(size, Image.Resampling.BOX)
    return torch.from_numpy(np.array(small))


def move_boxes(
    boxes: Float64[np.ndarray, "b 4"], size: tuple[int, int], lens: Lens
) -> Float64[np.ndarray, "b 4"]:
    """Boxes ``(x1, y1, x2, y2)`` of pixels, edges inclusive -> the smallest ones in the output that hold the moved outlines.

    A pixel of the output belongs to a box by its centre, as it belongs to a mask (`nearest_pixels`). A box of which the output
    shows nothing is NaN: no pixel lies in it.

    Args:
        boxes: In pixels of an image that covers the file; a box of two other corners is the same box.
        size: Width and height of that image; it may be coarser or finer than the file.
        lens: The mapping.
    """
    ratio = np.divide(lens.file_size, size)
    corners = boxes.reshape(-1, 2, 2)
    lows = np.ceil(corners.min(axis=1)) * ratio
    highs = (np.floor(corners.max(axis=1)) + 1) * ratio
    moved = np.full_like(boxes, np.nan)
    for i, (low, high) in enumerate(zip(lows, highs, strict=True)):
        at = lens.from_file(low + _border((1, 1), margin=0.0, samples=33) * (high - low))
        at = at[np.isfinite(at).all(axis=1)]
        if len(at):
            first, last = np.ceil(at.min(axis=0) - 0.5), np.ceil(at.max(axis=0) - 0.5) - 1
            if (first <= last).all():
                moved[i] = [*first, *last]
    return moved


def _undistort(
    camera: SparseCamera, file_size: tuple[int, int], source: str
) -> tuple[SparseCamera, SparseCamera]:
    """The camera at the file's resolution, and the pinhole camera that shows its undistorted image."""
    pycolmap = import_pycolmap()
    bent = _pycolmap_camera(camera)
    bent.rescale(*file_size)
    try:
        flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), bent)
    except (ValueError, RuntimeError) as error:
        what = f"camera {camera.camera_id}: model must be one that can be undistorted, got {camera.model}"
        advice = "crop perspective images from it, then run COLMAP on those"
        raise SceneError(Fault(source, what, advice)) from error
    distorted = replace(camera, width=bent.width, height=bent.height, params=tuple(bent.params))
    pinhole = SparseCamera(camera.camera_id, "PINHOLE", flat.width, flat.height, tuple(flat.params))
    return distorted, pinhole


def _scaled_pinhole(camera: SparseCamera, file_size: tuple[int, int]) -> SparseCamera:
    fx, fy, cx, cy = camera.intrinsics()
    sx, sy = (
        side / own for side, own in zip(file_size, (camera.width, camera.height), strict=True)
    )
    params = (fx * sx, fy * sy, cx * sx, cy * sy)
    return SparseCamera(camera.camera_id, "PINHOLE", *file_size, params)


def _require_invertible(lens: Lens, camera: SparseCamera, source: str) -> None:
    """Refuse distortion that cannot be inverted: at the border and in the middle, undistorting must undo distorting."""
    xy = np.concatenate([_border(lens.size, margin=0.5), np.divide(lens.size, 2)[None]])
    returned = lens.from_file(lens.to_file(xy))
    if np.abs(returned - xy).max() < 0.5:  # False for NaN
        return
    what = f"parameters must describe an invertible lens, got {camera.model} {camera.params}"
    raise SceneError(Fault(source, f"camera {camera.camera_id}: {what}", "calibrate it again"))


def _pycolmap_camera(camera: SparseCamera) -> Any:
    return import_pycolmap().Camera(
        camera_id=camera.camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=camera.params,
    )


def _pixel_centers(
    size: tuple[int, int],
) -> Iterator[tuple[slice, Float64[np.ndarray, "p 2"]]]:
    """Blocks of rows with the centres of their pixels."""
    width, height = size
    step = max(1, _BLOCK // width)
    for top in range(0, height, step):
        ys, xs = np.mgrid[top : min(top + step, height), 0:width] + 0.5
        yield slice(top, top + step), np.stack([xs.ravel(), ys.ravel()], axis=1)


def _inside(xy: Float64[np.ndarray, "p 2"], size: tuple[int, int]) -> Bool[np.ndarray, " p"]:
    """Whether positions lie on pixels of an image; False for NaN."""
    x, y = xy.T
    return (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])


def _border(
    size: tuple[int, int], margin: float, samples: int | None = None
) -> Float64[np.ndarray, "p 2"]:
    """Points along the outline of an image, `margin` pixels inside it."""
    width, height = size
    xs = np.linspace(margin, width - margin, samples or width)
    ys = np.linspace(margin, height - margin, samples or height)
    sides = [(xs, margin), (xs, height - margin), (margin, ys), (width - margin, ys)]
    return np.concatenate([np.stack(np.broadcast_arrays(x, y), axis=1) for x, y in sides])
