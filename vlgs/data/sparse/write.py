"""A `SparseModel` as COLMAP's files, through COLMAP's own writer."""

from pathlib import Path
from typing import Any

import numpy as np

from vlgs.data.diagnostics import SceneError
from vlgs.data.lens import import_pycolmap
from vlgs.data.sparse import read_sparse
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
        ValueError: If the folder is not new or empty, or COLMAP refuses the tracks or rigs of its files, or reads other images there.
        OSError: If it cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"colmap: OUT must be a new or empty folder, got {folder}")
    whole = reread(model) if model.suffix in (".bin", ".txt") else _rebuild(model)
    with new_folder(folder) as out:
        whole.write_text(str(out)) if text else whole.write(str(out))
        _require_written(out, ".txt" if text else ".bin", whole, folder)


def _require_written(out: Path, suffix: str, whole: Any, folder: Path) -> None:
    """Read back what was written: COLMAP's writer says nothing of a disk that is full.

    Raises:
        OSError: If it is not all of it; names `folder`.
    """
    expected = (whole.num_cameras(), whole.num_images(), whole.num_points3D())
    try:
        read = read_sparse(out, suffix)
        found = (len(read.cameras), len(read.images), len(read.points))
        # A number that is cut in its middle is one too.
        ended = suffix == ".bin" or all(f.read_bytes()[-1:] == b"\n" for f in out.iterdir())
    except SceneError:
        found, ended = (0, 0, 0), False
    if found != expected or not ended:
        what = "{} cameras, {} images and {} points".format(*expected)
        raise OSError(
            f"colmap: {folder} must hold {what} once written, got a part of them; is the disk full?"
        )


def reread(model: SparseModel) -> Any:
    """COLMAP's own `pycolmap.Reconstruction` of the files of a model, with its tracks.

    Raises:
        ValueError: If COLMAP refuses the tracks or rigs, or reads other images or points there.
    """
    try:
        whole = import_pycolmap().Reconstruction(str(model.folder))
    except (ValueError, IndexError, RuntimeError) as error:  # what its C++ throws
        raise ValueError(
            f"colmap: tracks and rigs of {model.folder} must be those of its images, got: {error}"
        ) from error
    names = {image.image_id: image.name for image in model.images}
    if set(whole.images) != set(names) or whole.num_points3D() != len(model.points):
        raise ValueError(
            f"colmap: {model.folder} must hold {len(names)} images and {len(model.points)} points with their ids for COLMAP too, "
            f"got {whole.num_images()} and {whole.num_points3D()}"
        )
    for number, name in names.items():  # COLMAP's reader of text ends a name at its first blank
        whole.image(number).name = name
    return whole


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
