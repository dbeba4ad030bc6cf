"""Quaternions, rotations and cameras as pure functions. Conventions are those of `vlgs.types`."""

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.types import Camera


def quat_to_rotmat(quats: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z), which need not be normalised.

    The rows of a zero quaternion come back as NaN: whoever may have one must look first.

    Example:
        >>> quat_to_rotmat(torch.tensor([2.0, 0.0, 0.0, 0.0])).diagonal()
        tensor([1., 1., 1.])
    """
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotmat_to_quat(rotmats: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternions (w, x, y, z) of rotation matrices, with w >= 0.

    All four of Shepperd's candidates are formed and the one with the largest pivot is taken, so that no division is by a
    small number anywhere on SO(3).
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotmats.flatten(-2).unbind(-1)
    pivots = torch.stack(
        [
            1 + m00 + m11 + m22,
            1 + m00 - m11 - m22,
            1 - m00 + m11 - m22,
            1 - m00 - m11 + m22,
        ],
        dim=-1,
    )
    candidates = torch.stack(
        [
            torch.stack([pivots[..., 0], m21 - m12, m02 - m20, m10 - m01], dim=-1),
            torch.stack([m21 - m12, pivots[..., 1], m10 + m01, m02 + m20], dim=-1),
            torch.stack([m02 - m20, m10 + m01, pivots[..., 2], m21 + m12], dim=-1),
            torch.stack([m10 - m01, m02 + m20, m21 + m12, pivots[..., 3]], dim=-1),
        ],
        dim=-2,
    )
    best = pivots.argmax(dim=-1)[..., None, None].expand(*pivots.shape[:-1], 1, 4)
    quats = candidates.gather(-2, best).squeeze(-2)
    quats = quats / quats.norm(dim=-1, keepdim=True)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def camera_center(viewmat: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 3"]:
    """Position of the camera in the world, ``-R^T t``."""
    return -(viewmat[..., :3, :3].mT @ viewmat[..., :3, 3:]).squeeze(-1)


def pose_matrix(
    rotation: Float[Tensor, "*b 3 3"], center: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    """World-to-camera matrix of a world-to-camera rotation and a camera centre."""
    viewmat = torch.zeros(*rotation.shape[:-2], 4, 4, dtype=rotation.dtype)
    viewmat[..., :3, :3] = rotation
    viewmat[..., :3, 3] = -(rotation @ center[..., None]).squeeze(-1)
    viewmat[..., 3, 3] = 1
    return viewmat


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same camera for an image of another size; each axis is scaled on its own."""
    scale = torch.tensor([width / camera.width, height / camera.height, 1.0], dtype=camera.K.dtype)
    return Camera(camera.viewmat, camera.K * scale[:, None], width, height)


def subsample_camera(camera: Camera, step: int) -> Camera:
    """The camera whose pixels are every `step`-th of every `step`-th row, from the first: their centres see where they saw before."""
    rows, columns = -(-camera.height // step), -(-camera.width // step)
    K = camera.K / step
    K[2, 2] = 1
    K[:2, 2] += 0.5 - 0.5 / step
    return Camera(camera.viewmat, K, columns, rows)


def scene_extent(viewmats: Float[Tensor, "v 4 4"]) -> float:
    """1.1 x the largest distance of a camera from the mean camera centre (3DGS); 1.0 for cameras in one place.

    The learning rate of positions and the thresholds of densification are in this unit.
    """
    centers = camera_center(viewmats)
    radius = (centers - centers.mean(dim=0)).norm(dim=-1).max().item()
    # Cameras that only turn have one centre up to the rounding of -R^T t.
    rounding = 64 * torch.finfo(centers.dtype).eps * centers.norm(dim=-1).max().item()
    return 1.1 * radius if radius > rounding else 1.0
