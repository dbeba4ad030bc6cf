"""The camera between two cameras (Eqs. 9 and 10 with their errors set right; conf/README.md, D.1 to D.5)."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.geometry import camera_center, pose_matrix, quat_to_rotmat, rotmat_to_quat
from vlgs.types import Camera
from vlgs.view_blend.ratio import Convention, ViewBlend


def slerp(
    quats1: Float[Tensor, "*b 4"],
    quats2: Float[Tensor, "*b 4"],
    k: float | Float[Tensor, "*b"],
    convention: Convention = "consistent",
) -> Float[Tensor, "*b 4"]:
    """Unit quaternions on the short arc between two rotations; k = 1 is rotation 1, k = 0 rotation 2.

    ``consistent`` turns at constant speed, by ``1 - k`` of the angle from rotation 1, whatever the signs of the inputs.
    Eq. 9 changes to a normalised lerp above ``|cos| = 0.995`` "for efficiency"; the weights here are those of its
    slerp branch, set right, in a form that is lerp in the limit. They need no branch, are continuous, and differ from that
    lerp by at most 1.6e-5 rad of quaternion angle. ``paper`` is Eq. 9 to the letter, for ablation: k swaps its
    meaning between the branches, theta is not that of the flipped pair, and only ``0/0`` at ``cos = 0`` is settled (as +1).

    Args:
        quats1: (w, x, y, z), any length but zero.
        quats2: Likewise.
        k: Weight of rotation 1; outside [0, 1] the arc is continued.
        convention: Which formula.

    Raises:
        ValueError: If a quaternion is zero or not finite.
    """
    quats1, quats2 = _unit(quats1), _unit(quats2)
    ratio = torch.as_tensor(k, dtype=quats1.dtype)[..., None]
    cosine = (quats1 * quats2).sum(dim=-1, keepdim=True).clamp(-1, 1)
    quats1 = torch.where(cosine < 0, -quats1, quats1)
    weigh = _paper_weights if convention == "paper" else _slerp_weights
    weight1, weight2 = weigh(cosine, ratio)
    blended = weight1 * quats1 + weight2 * quats2
    return blended / blended.norm(dim=-1, keepdim=True)


def blend_camera(camera1: Camera, camera2: Camera, k: float, blend: ViewBlend) -> Camera:
    """The blended view W_b: rotation by `slerp`, centre ``k c1 + (1 - k) c2`` with c = -R^T t, intrinsics likewise.

    Poses are computed in float64 and returned in the type of `camera1`. In the consistent convention k = 1 returns `camera1`
    itself, and k = 0 `camera2` itself if both switches are on. Intrinsics are never extrapolated.

    Raises:
        ValueError: If the image sizes differ or k is not finite.
    """
    return blend_cameras([camera1], [camera2], [k], blend)[0]


def blend_cameras(
    cameras1: Sequence[Camera], cameras2: Sequence[Camera], ks: Sequence[float], blend: ViewBlend
) -> list[Camera]:
    """`blend_camera` of many pairs, which takes hardly longer than one: the tensors are tiny.

    Raises:
        ValueError: If the image sizes of a pair differ or a k is not finite.
    """
    for camera1, camera2, k in zip(cameras1, cameras2, ks, strict=True):
        sizes = ((camera1.width, camera1.height), (camera2.width, camera2.height))
        if sizes[0] != sizes[1]:
            raise ValueError(
                f"blend_camera: image sizes must be equal, got {sizes[0]} and {sizes[1]}"
            )
        if not math.isfinite(k):
            raise ValueError(f"blend_camera: k must be finite, got {k}")
    if not ks:
        return []
    ratio = torch.tensor(ks, dtype=torch.float64)
    ones, twos = (torch.stack([c.viewmat for c in many]).double() for many in (cameras1, cameras2))
    kept = ones
    if blend.kept == "nearer":
        kept = torch.where(ratio[:, None, None] < 0.5, twos, ones)
    rotation, center = kept[:, :3, :3], camera_center(kept)
    if blend.rotation:
        quats1, quats2 = rotmat_to_quat(ones[:, :3, :3]), rotmat_to_quat(twos[:, :3, :3])
        rotation = quat_to_rotmat(slerp(quats1, quats2, ratio, blend.convention))
    if blend.translation:
        center = torch.lerp(camera_center(twos), camera_center(ones), ratio[:, None])
    viewmats = pose_matrix(rotation, center).to(cameras1[0].viewmat.dtype)
    K1, K2 = (torch.stack([c.K for c in many]) for many in (cameras1, cameras2))
    Ks = torch.lerp(K2, K1, ratio.clamp(0, 1).to(K1.dtype)[:, None, None])
    blended = []
    for camera1, camera2, k, viewmat, K in zip(cameras1, cameras2, ks, viewmats, Ks, strict=True):
        camera = Camera(viewmat, K, camera1.width, camera1.height)
        if blend.convention == "consistent":
            if k == 1:
                camera = camera1
            elif k == 0 and blend.rotation and blend.translation:
                camera = camera2
        blended.append(camera)
    return blended


def _slerp_weights(cosine: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """``sin(k t) / sin(t)`` and ``sin((1 - k) t) / sin(t)``; as ratios of sinc they have no 0/0 at t = 0."""
    turns = torch.arccos(cosine.abs()) / math.pi
    whole = torch.sinc(turns)  # t <= pi/2, so at least 2/pi
    return k * torch.sinc(k * turns) / whole, (1 - k) * torch.sinc((1 - k) * turns) / whole


def _paper_weights(cosine: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    theta = torch.arccos(cosine)
    aligned = cosine.abs() > 0.995
    sine = torch.where(aligned, torch.ones_like(theta), theta.sin())
    weight1 = torch.where(aligned, k, (theta - k * theta).sin() / sine)
    return weight1, torch.where(aligned, 1 - k, (k * theta).sin() / sine)


def _unit(quats: Tensor) -> Tensor:
    length = quats.norm(dim=-1, keepdim=True)
    if not ((length > 0) & length.isfinite()).all():
        raise ValueError(
            f"slerp: lengths of quaternions must be positive and finite, got {length.flatten().tolist()[:8]}"
        )
    return quats / length
