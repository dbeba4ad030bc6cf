"""A `SparseModel` as COLMAP's files, through COLMAP's own writer."""

from pathlib import Path
from typing import Any

import numpy as np

from vlgs.data.lens import import_pycolmap
from vlgs.data.sparse.model import SparseModel
from vlgs.files import new_folder


def write_colmap(folder: Path, model: SparseModel, text: bool = False) -> None:
    """Write cameras, images and points to a new folder: all of it, or nothing.

    A reconstruction that is COLMAP's own keeps what a `SparseModel` has no place for: rigs, 2D points, and the tracks that tie
    them to the sparse points.

    Args:
        folder: To be made.
        model: As from `vlgs.data.sparse.read_cameras`, so that its files have been read to the last byte.
        text: ``.txt`` in place of ``.bin``.

    Raises:
        ValueError: If the folder is not new or empty, or COLMAP refuses the tracks or rigs of its files.
        OSError: If it cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"colmap: OUT must be a new or empty folder, got {folder}")
    whole = _reread(model) if model.suffix in (".bin", ".txt") else _rebuild(model)
    with new_folder(folder) as out:
        whole.write_text(str(out)) if text else whole.write(str(out))


def _reread(model: SparseModel) -> Any:
    try:
        return import_pycolmap().Reconstruction(str(model.folder))
    except (ValueError, IndexError, RuntimeError) as error:  # what its C++ throws
        raise ValueError(
            f"colmap: tracks and rigs of {model.folder} must be those of its images, got: {error}"
        ) from error


def _rebuild(model: SparseModel) -> Any:
    """A reconstruction of cameras, poses and points alone."""
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
    return out
