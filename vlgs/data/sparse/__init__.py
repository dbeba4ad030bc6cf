"""COLMAP's sparse reconstruction: files -> `SparseModel`."""

from pathlib import Path

from vlgs.data.sparse import binary, text
from vlgs.data.sparse.model import (
    SparseCamera,
    SparseImage,
    SparseModel,
    camera_faults,
    image_faults,
    model_faults,
)

__all__ = [
    "SparseCamera",
    "SparseImage",
    "SparseModel",
    "camera_faults",
    "find_sparse",
    "image_faults",
    "model_faults",
    "read_sparse",
]

_STEMS = ("cameras", "images", "points3D")


def find_sparse(root: Path) -> tuple[Path, str] | None:
    """Folder and suffix of a scene's reconstruction, binary before text as in COLMAP; None where there is none."""
    for folder in (root / "sparse" / "0", root / "sparse"):
        for suffix in (".bin", ".txt"):
            if all((folder / f"{stem}{suffix}").is_file() for stem in _STEMS):
                return folder, suffix
    return None


def read_sparse(folder: Path, suffix: str) -> SparseModel:
    """Read the three files of a reconstruction. ``rigs`` and ``frames`` (COLMAP 3.12) repeat what they say.

    Args:
        folder: Where they lie.
        suffix: ``.bin`` or ``.txt``.

    Raises:
        SceneError: If one is not written as its format says; `model_faults` judges what they say.
    """
    reader = binary if suffix == ".bin" else text
    cameras = reader.read_cameras(folder / f"cameras{suffix}")
    images = reader.read_images(folder / f"images{suffix}")
    ids, points, colors = reader.read_points(folder / f"points3D{suffix}")
    return SparseModel(folder, suffix, cameras, images, ids, points, colors)
