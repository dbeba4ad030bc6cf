"""Cameras, poses and points: COLMAP's files, transforms.json or poses_bounds.npy -> `SparseModel`."""

from pathlib import Path

from vlgs.data.diagnostics import require_sound
from vlgs.data.sparse import binary, llff, text, transforms
from vlgs.data.sparse.model import (
    SparseCamera,
    SparseImage,
    SparseModel,
    camera_faults,
    image_faults,
    model_faults,
)
from vlgs.data.sparse.origin import (
    AT_HOME,
    Origin,
    moved,
    origin_of,
    origin_warnings,
    subtracted,
)
from vlgs.data.sparse.transforms import write_transforms

__all__ = [
    "AT_HOME",
    "Origin",
    "SparseCamera",
    "SparseImage",
    "SparseModel",
    "camera_faults",
    "find_sparse",
    "image_faults",
    "model_faults",
    "moved",
    "origin_of",
    "origin_warnings",
    "read_cameras",
    "read_sparse",
    "subtracted",
    "write_transforms",
]

_STEMS = ("cameras", "images", "points3D")


def find_sparse(root: Path) -> tuple[Path, str] | None:
    """Folder and suffix of a scene's reconstruction; None where there is none.

    COLMAP's before the others, since only they have tracked points; of these binary before text, as in COLMAP.
    """
    for folder in (root / "sparse" / "0", root / "sparse"):
        for suffix in (".bin", ".txt"):
            if all((folder / f"{stem}{suffix}").is_file() for stem in _STEMS):
                return folder, suffix
    for name in (transforms.FILE, llff.FILE):
        if (root / name).is_file():
            return root, name
    return None


def read_sparse(folder: Path, suffix: str) -> SparseModel:
    """Read the three files of a reconstruction. ``rigs`` and ``frames`` (COLMAP 3.12) repeat what they say.

    Args:
        folder: Where they lie.
        suffix: ``.bin`` or ``.txt``, or the name of the one file, as from `find_sparse`.

    Raises:
        SceneError: If one is not written as its format says; `model_faults` judges what they say.
    """
    if suffix == transforms.FILE:
        return transforms.read_transforms(folder / suffix)
    if suffix == llff.FILE:
        return llff.read_llff(folder / suffix)
    reader = binary if suffix == ".bin" else text
    cameras = reader.read_cameras(folder / f"cameras{suffix}")
    images = reader.read_images(folder / f"images{suffix}")
    ids, points, colors = reader.read_points(folder / f"points3D{suffix}")
    return SparseModel(folder, suffix, cameras, images, ids, points, colors)


def read_cameras(source: Path) -> SparseModel:
    """Cameras of a scene's folder, of a folder of COLMAP's files, or of a transforms.json of any name, all of it sound.

    Raises:
        FileNotFoundError: If there are none.
        SceneError: If they contradict themselves or their format.
    """
    if source.is_file():
        model = transforms.read_transforms(source)
    else:
        found = find_sparse(source)
        for suffix in (".bin", ".txt"):
            if found is None and all((source / f"{stem}{suffix}").is_file() for stem in _STEMS):
                found = source, suffix
        if found is None:
            what = "must hold COLMAP's files, transforms.json or poses_bounds.npy, got none"
            raise FileNotFoundError(f"cameras: {source} {what}")
        model = read_sparse(*found)
    require_sound(model_faults(model))
    return model
