"""A `SparseModel` as COLMAP's files, through COLMAP's own writer."""

import tempfile
from pathlib import Path

import numpy as np

from vlgs.data.lens import import_pycolmap
from vlgs.data.sparse.model import SparseModel


def write_colmap(folder: Path, model: SparseModel, text: bool = False) -> None:
    """Write cameras, images and points to a new folder: all of it, or nothing. Tracks are not part of a `SparseModel`.

    Raises:
        ValueError: If the folder is not new or empty.
        OSError: If it cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"colmap: OUT must be a new or empty folder, got {folder}")
    pycolmap = import_pycolmap()
    out = pycolmap.Reconstruction()
    for camera in model.cameras:
        out.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model=camera.model,
                width=camera.width,
                height=camera.height,
                params=camera.params,
                camera_id=camera.camera_id,
            )
        )
    for image in model.images:
        w, x, y, z = image.quat
        rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
        pose = pycolmap.Rigid3d(rotation, np.array(image.translation))
        entry = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        out.add_image_with_trivial_frame(entry, pose)
    for point, color in zip(model.points, model.point_colors, strict=True):
        out.add_point3D(point, pycolmap.Track(), color)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as scratch:
        whole = Path(scratch) / "model"
        whole.mkdir()
        out.write_text(str(whole)) if text else out.write(str(whole))
        whole.replace(folder)
