"""COLMAP's binary model ("Output Format" in its documentation), written from cameras and coloured points."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from vlgs.geometry import rotmat_to_quat
from vlgs.types import Camera, Scene, View

_PINHOLE = 1
_ALIKE = 24
"""Largest difference per colour channel (of 255) between a point and a pixel that counts as its observation."""


def write_sparse(folder: Path, scene: Scene, views: Sequence[View]) -> None:
    """Write cameras.bin, images.bin and points3D.bin.

    A scene holds no tracks. A point counts as observed where it projects onto a pixel of its own colour: occluded and
    stray points then have few observations, as they would from matching.
    """
    folder.mkdir(parents=True)
    lenses = {_lens(view.camera): None for view in views}
    lens_ids = {lens: number + 1 for number, lens in enumerate(lenses)}
    seen = [_observe(scene, view) for view in views]

    with (folder / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(lens_ids)))
        for (width, height, *params), number in lens_ids.items():
            file.write(struct.pack("<iiQQ4d", number, _PINHOLE, width, height, *params))
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(views)))
        for number, (view, (ids, pixels)) in enumerate(zip(views, seen, strict=True), start=1):
            pose = view.camera.viewmat.double()
            quat = rotmat_to_quat(pose[:3, :3]).tolist()
            lens = lens_ids[_lens(view.camera)]
            file.write(struct.pack("<i7di", number, *quat, *pose[:3, 3].tolist(), lens))
            file.write(f"{view.name}.png".encode() + b"\0" + struct.pack("<Q", len(ids)))
            rows = np.zeros(len(ids), [("xy", "<f8", 2), ("point", "<i8")])
            rows["xy"], rows["point"] = pixels, ids + 1
            file.write(rows.tobytes())
    with (folder / "points3D.bin").open("wb") as file:
        file.write(_points(scene, [ids for ids, _ in seen]))


def _lens(camera: Camera) -> tuple[int, int, float, float, float, float]:
    K = camera.K.double()
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return camera.width, camera.height, fx, fy, cx, cy


def _observe(scene: Scene, view: View) -> tuple[Int[np.ndarray, " o"], Float[np.ndarray, "o 2"]]:
    """Rows of the points that a view shows, and where."""
    camera, image = view.camera, view.read_image()
    pose, K = camera.viewmat.double(), camera.K.double()
    local = scene.points.double() @ pose[:3, :3].T + pose[:3, 3]
    pixel = local[:, :2] / local[:, 2:].clamp_min(1e-6) * K.diagonal()[:2] + K[:2, 2]
    size = torch.tensor([camera.width, camera.height])
    inside = (local[:, 2] > 1e-3) & (pixel >= 0).all(1) & (pixel < size).all(1)
    rows = inside.nonzero().squeeze(1)
    x, y = pixel[rows].long().unbind(1)
    step = (image[y, x].int() - scene.point_colors[rows].int()).abs().amax(1)
    rows = rows[step <= _ALIKE]
    return rows.numpy(), pixel[rows].numpy()


def _points(scene: Scene, seen: Sequence[Int[np.ndarray, " _"]]) -> bytes:
    tracks: list[list[tuple[int, int]]] = [[] for _ in range(len(scene.points))]
    for image, ids in enumerate(seen, start=1):
        for observation, point in enumerate(ids.tolist()):
            tracks[point].append((image, observation))
    parts = [struct.pack("<Q", len(tracks))]
    xyz, rgb = scene.points.double().tolist(), scene.point_colors.tolist()
    for number, track in enumerate(tracks):
        parts.append(struct.pack("<Q3d3Bd", number + 1, *xyz[number], *rgb[number], 0.0))
        flat = [value for pair in track for value in pair]
        parts.append(struct.pack(f"<Q{len(flat)}i", len(track), *flat))
    return b"".join(parts)
