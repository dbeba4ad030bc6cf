"""LLFF's ``poses_bounds.npy`` as a `SparseModel` without points: how 3D-OVS was released.

Row i belongs to the i-th image in order of name: a 3 x 5 matrix by rows, then the near and far bound, which are not used. Columns are
the camera's down, right and back axis in the world, its position, and (height, width, focal length).
"""

from pathlib import Path

import numpy as np
import torch

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.images import SUFFIXES
from vlgs.data.sparse.model import SparseCamera, SparseImage, SparseModel
from vlgs.data.sparse.transforms import is_rotation
from vlgs.data.untrusted.arrays import map_npy
from vlgs.geometry import rotmat_to_quat

FILE = "poses_bounds.npy"


def read_llff(path: Path) -> SparseModel:
    """Cameras and poses; the images are those in ``images/`` beside the file.

    Raises:
        SceneError: If the file is not such an array, has not one row for each image, or has axes that are no rotation.
    """
    rows = map_npy(path)
    names = sorted(
        p.name for p in (path.parent / "images").iterdir() if p.suffix.lower() in SUFFIXES
    )
    if rows.shape != (len(names), 17) or rows.dtype.kind != "f" or not np.isfinite(rows).all():
        what = f"array must be finite floats [{len(names)}, 17], a row for each image"
        raise SceneError(Fault(str(path), f"{what}, got {rows.dtype} {list(rows.shape)}"))
    cameras: dict[tuple[int, int, float], SparseCamera] = {}
    images = []
    for number, (name, row) in enumerate(zip(names, rows[:, :15].astype(np.float64), strict=True)):
        down, right, back, center, (height, width, focal) = row.reshape(3, 5).T
        turn = np.stack([right, down, -back])  # world to camera
        if not is_rotation(turn):
            what = "axes must be down, right and back, of length 1 and at right angles"
            got = [down.tolist(), right.tolist(), back.tolist()]
            raise SceneError(Fault(str(path), f"{what}, got {got}", where=f"row {number}"))
        key = (round(float(width)), round(float(height)), float(focal))
        middle = (key[0] / 2, key[1] / 2)
        new = SparseCamera(len(cameras) + 1, "SIMPLE_PINHOLE", *key[:2], (key[2], *middle))
        camera = cameras.setdefault(key, new)
        quat = rotmat_to_quat(torch.from_numpy(turn))
        translation = tuple((-turn @ center).tolist())
        pose = (tuple(quat.tolist()), translation)
        images.append(SparseImage(number + 1, camera.camera_id, name, *pose, observations=-1))
    none = (np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    return SparseModel(path.parent, FILE, tuple(cameras.values()), tuple(images), *none)
