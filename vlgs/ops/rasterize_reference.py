"""The definition of a correct image: dense, pure PyTorch, differentiated by autograd.

Every Gaussian is evaluated at every pixel, so memory is O(n h w). Nothing here is shared with the kernel in `csrc`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vlgs.types import Camera, ChannelGroup, DepthKind, RasterConfig, Rendered


class _Splats(NamedTuple):
    """Gaussians on the image plane; rows that are culled hold harmless numbers."""

    mean2d: Float[Tensor, "n 2"]
    cov2d: Float[Tensor, "n 3"]
    """Covariance (xx, xy, yy) in pixel^2, blur included."""
    det: Float[Tensor, " n"]
    """Its determinant, formed without cancellation."""
    depth: Float[Tensor, " n"]
    in_front: Bool[Tensor, " n"]
    """Beyond the near plane, by its own depth as well (`RasterConfig.near_sigmas`), and with a rotation."""


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    groups: Sequence[ChannelGroup],
    camera: Camera,
    config: RasterConfig,
) -> Rendered:
    """Image, accumulated weight and gradients as `vlgs.rasterize` defines them (Eqs. 1 and 6)."""
    splats = _project(means, quats, scales, camera, config)
    front_to_back = _front_to_back(splats)
    images, alphas = [], []
    visible = torch.zeros_like(splats.in_front)
    for group in groups:
        shape, order = splats, front_to_back
        if group.shape is not None:
            own = _project(means, group.shape.quats, group.shape.scales, camera, config)
            shape, order = own._replace(mean2d=splats.mean2d), order[own.in_front[order]]
        if not group.shape_grad:
            shape = _Splats(*(t.detach() for t in shape))
        alpha = _alpha(shape, order, group.weight, camera, config)
        visible[order] |= alpha.any(dim=1)
        image, accumulated = _blend(alpha, group.values[order], config)
        images.append(image.unflatten(0, (camera.height, camera.width)))
        alphas.append(accumulated.unflatten(0, (camera.height, camera.width)))
    return Rendered(tuple(images), tuple(alphas), visible, splats.mean2d)


def render_depth(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    camera: Camera,
    config: RasterConfig,
    kind: DepthKind,
) -> Float[Tensor, "h w"]:
    """Depth and gradients as `vlgs.ops.depth.render_depth` defines them."""
    splats = _project(means, quats, scales, camera, config)
    order = _front_to_back(splats)
    alpha, before = _stopped(_alpha(splats, order, opacities, camera, config), config)
    if kind == "median":
        weights = ((before > 0.5) & (before * (1 - alpha) <= 0.5)).to(alpha)
    else:
        weights = alpha * before
    image = weights.T @ splats.depth[order]
    if kind == "expected":
        total = weights.sum(dim=0)
        image = torch.where(total > 0, image / torch.where(total > 0, total, 1), 0)
    return image.unflatten(0, (camera.height, camera.width))


def _project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    camera: Camera,
    config: RasterConfig,
) -> _Splats:
    """Perspective projection of centres and its local linearisation for covariances (Zwicker et al. 2001)."""
    viewmat, K = camera.viewmat.to(means), camera.K.to(means)
    focal, center = K.diagonal()[:2], K[:2, 2]
    size = torch.tensor([camera.width, camera.height], dtype=means.dtype)

    in_camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    in_front = (in_camera[:, 2] > config.near) & (quats.square().sum(dim=1) > 0)
    if config.near_sigmas > 0:
        along_view = viewmat[2, :3] @ (_rotations(quats, in_front) * scales[:, None, :])
        in_front &= in_camera[:, 2] > config.near_sigmas * along_view.norm(dim=1)
    in_camera = torch.where(in_front[:, None], in_camera, torch.ones_like(in_camera))
    depth = in_camera[:, 2]
    slope = in_camera[:, :2] / depth[:, None]
    margin = config.fov_margin * size / 2
    clamped = torch.clamp(slope, -(center + margin) / focal, (size - center + margin) / focal)

    jacobian = means.new_zeros(len(means), 2, 3)
    jacobian[:, 0, 0] = focal[0] / depth
    jacobian[:, 1, 1] = focal[1] / depth
    jacobian[:, :, 2] = -focal * clamped / depth[:, None]
    axes = _rotations(quats, in_front) * scales[:, None, :]
    v1, v2 = (jacobian @ viewmat[:3, :3] @ axes).unbind(1)

    eps = config.eps2d
    xx, xy, yy = (v1 * v1).sum(1), (v1 * v2).sum(1), (v2 * v2).sum(1)
    det = torch.linalg.cross(v1, v2).square().sum(1) + eps * (xx + yy) + eps**2
    mean2d = torch.where(in_front[:, None], slope * focal + center, 0)
    return _Splats(mean2d, torch.stack([xx + eps, xy, yy + eps], 1), det, depth, in_front)


def _rotations(quats: Float[Tensor, "n 4"], valid: Bool[Tensor, " n"]) -> Float[Tensor, "n 3 3"]:
    """R v = v + 2 a x (a x v + w v) for the unit quaternion (w, a), as a matrix: I + 2 (w [a]x + [a]x [a]x)."""
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype)
    unit = torch.nn.functional.normalize(torch.where(valid[:, None], quats, identity), dim=1, eps=0)
    w, x, y, z = unit.unbind(1)
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).unflatten(1, (3, 3))
    return torch.eye(3, dtype=quats.dtype) + 2 * (w[:, None, None] * cross + cross @ cross)


def _front_to_back(splats: _Splats) -> Int[Tensor, " m"]:
    """Rows that are not culled; ties in their own order."""
    order = torch.argsort(splats.depth, stable=True)
    return order[splats.in_front[order]]


def _alpha(
    splats: _Splats, order: Tensor, weight: Tensor, camera: Camera, config: RasterConfig
) -> Float[Tensor, "m p"]:
    """What each Gaussian covers of each pixel, if nothing lies before it."""
    exponent = _exponent(splats, order, camera.width, camera.height)
    alpha = weight[order, None] * torch.exp(-exponent)
    return torch.where(alpha >= config.alpha_min, alpha.clamp(max=config.alpha_max), 0)


def _exponent(splats: _Splats, order: Tensor, width: int, height: int) -> Float[Tensor, "m p"]:
    """Half the squared Mahalanobis distance of every pixel centre, pixels row by row."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=splats.depth.dtype) + 0.5,
        torch.arange(width, dtype=splats.depth.dtype) + 0.5,
        indexing="ij",
    )
    dx = x.flatten() - splats.mean2d[order, 0, None]
    dy = y.flatten() - splats.mean2d[order, 1, None]
    xx, xy, yy = splats.cov2d[order, :, None].unbind(1)
    return 0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / splats.det[order, None]


def _blend(
    alpha: Float[Tensor, "m p"], values: Float[Tensor, "m c"], config: RasterConfig
) -> tuple[Float[Tensor, "p c"], Float[Tensor, " p"]]:
    """Front-to-back sum of ``values_i alpha_i prod_{j<i} (1 - alpha_j)`` and the accumulated weight."""
    alpha, before = _stopped(alpha, config)
    return (alpha * before).T @ values, 1 - torch.prod(1 - alpha, dim=0)


def _stopped(
    alpha: Float[Tensor, "m p"], config: RasterConfig
) -> tuple[Float[Tensor, "m p"], Float[Tensor, "m p"]]:
    """Alpha of what is drawn before a pixel is done, 0 behind it, and ``prod_{j<i} (1 - alpha_j)``."""
    after = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat([torch.ones_like(alpha[:1].new_ones(1, alpha.shape[1])), after])[:-1]
    # T never grows, so that "still above the threshold" is the whole of the stopping rule.
    live = (before if config.stop == "after" else after) > config.transmittance_min
    return torch.where(live, alpha, 0), before
