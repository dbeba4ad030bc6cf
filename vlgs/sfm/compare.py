"""The distance between two sets of cameras of the same photographs, after their worlds are aligned by a similarity transform."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from vlgs.data.sparse import find_sparse, read_sparse
from vlgs.geometry import quat_to_rotmat


@dataclass(frozen=True)
class PoseErrors:
    """Of the photographs that both have, after the best similarity (Umeyama, PAMI 1991)."""

    common: int
    centers: Float64[np.ndarray, " n"]
    """Distances of camera centres as a share of the reference's spread (root mean square distance from their mean)."""
    degrees: Float64[np.ndarray, " n"]
    """Angles between the orientations."""


def compare_poses(scene: Path, reference: Path) -> PoseErrors:
    """Hold the cameras of one scene against those of another; photographs are matched by stem.

    Raises:
        ValueError: If one has no reconstruction, or they share fewer than three photographs.
    """
    own, theirs = _poses(scene), _poses(reference)
    names = sorted(own.keys() & theirs.keys())
    if len(names) < 3:
        raise ValueError(
            f"sfm: {scene} and {reference} must share at least 3 registered photographs, got {len(names)}"
        )
    rotations = [np.stack([poses[n][0] for n in names]) for poses in (own, theirs)]
    centers = [np.stack([-poses[n][0].T @ poses[n][1] for n in names]) for poses in (own, theirs)]
    scale, turn, shift = align(*centers)
    moved = scale * centers[0] @ turn.T + shift
    spread = np.sqrt(((centers[1] - centers[1].mean(axis=0)) ** 2).sum(axis=1).mean())
    between = rotations[0] @ turn.T @ rotations[1].transpose(0, 2, 1)
    # The sine keeps small angles exact where the cosine of the trace does not.
    skew = np.linalg.norm(between - between.transpose(0, 2, 1), axis=(1, 2)) / np.sqrt(8)
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    degrees = np.degrees(np.arctan2(skew, cosine))
    return PoseErrors(len(names), np.linalg.norm(moved - centers[1], axis=1) / spread, degrees)


def align(
    source: Float64[np.ndarray, "n 3"], target: Float64[np.ndarray, "n 3"]
) -> tuple[float, Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """Scale s, rotation R and shift t that minimise the squared distances of ``s R source + t`` and `target`."""
    from_mean, to_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - from_mean, target - to_mean
    u, s, vt = np.linalg.svd(b.T @ a)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ mirror @ vt
    scale = float((s * mirror.diagonal()).sum() / (a**2).sum())
    return scale, turn, to_mean - scale * turn @ from_mean


def _poses(scene: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Stem -> rotation and translation, world to camera."""
    found = find_sparse(scene)
    if found is None:
        raise ValueError(f"sfm: {scene} must hold a COLMAP model in sparse/0, got none")
    return {
        Path(image.name).stem: (
            quat_to_rotmat(torch.tensor(image.quat, dtype=torch.float64)).numpy(),
            np.array(image.translation),
        )
        for image in read_sparse(*found).images
    }
