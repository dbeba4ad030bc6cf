"""One view of Gaussians by gsplat's conventions: what is projected, and the figures about it that gsplat reports."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.ops.depth import camera_depth
from vlgs.ops.project import Splats, project
from vlgs.types import Camera, RasterConfig

_WIDEST = 3.33
"""Deviations at which gsplat cuts a Gaussian of opacity 1, where alpha falls to 1/255."""
_LARGEST = 1 << 30
"""Radii beyond this, in pixels, are given as this: they must fit 32 bits."""


@dataclass(frozen=True)
class Culling:
    """What is not drawn, beside what does not reach the image."""

    far: float
    """Gaussians beyond this depth, in world units."""
    radius: float
    """Gaussians whose radii are both at most this, in pixels."""


@dataclass(frozen=True)
class ViewSplats:
    """Gaussians of one view; n are all of them, or those that are seen."""

    splats: Splats
    radii: Int32[Tensor, "n 2"]
    """Half the sides of the bounding box in pixels, 0 where a Gaussian is not seen."""
    depths: Float[Tensor, " n"]
    """Camera z, differentiable."""
    opacities: Float[Tensor, " n"]
    """What blends, weakened where that was asked for."""
    values: Float[Tensor, "n x"]
    """What is blended; depth, until there is a colour."""

    @property
    def seen(self) -> Bool[Tensor, " n"]:
        """What is drawn."""
        return self.radii[:, 0] > 0

    @property
    def conics(self) -> Float[Tensor, "n 3"]:
        """Upper triangle (xx, xy, yy) of the inverse 2D covariance, in 1 / pixel^2; it carries no gradient."""
        with torch.no_grad():
            x, slope, y = self.splats.ellipse.unbind(1)
            xx = x * x
            return torch.stack([xx, -xx * slope, xx * slope * slope + y * y], dim=1)

    def detach(self) -> "ViewSplats":
        """The same numbers, from which no gradient can be asked."""
        rest = (self.radii, self.depths, self.opacities, self.values)
        return ViewSplats(Splats(*(t.detach() for t in self.splats)), *(t.detach() for t in rest))

    def rows(self, index: Tensor) -> "ViewSplats":
        """Some of the Gaussians."""
        splats = Splats(*(t[index] for t in self.splats))
        rest = (self.radii, self.depths, self.opacities, self.values)
        return ViewSplats(splats, *(t[index] for t in rest))


def project_view(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    camera: Camera,
    config: RasterConfig,
    culling: Culling,
    antialiased: bool,
) -> ViewSplats:
    """Project, weaken what is smaller than a pixel if it is asked for, and cull."""
    splats = project(means, quats, scales, camera, config)
    if antialiased:
        factor = compensation(splats, means, quats, scales, camera, config)
        opacities = (opacities * factor).clamp_max(1.0)
    radii = _radii(splats, opacities.detach(), camera, config, culling)
    depth = torch.where(radii[:, 0] > 0, splats.depth, 0)
    depths = camera_depth(means, camera)
    return ViewSplats(splats._replace(depth=depth), radii, depths, opacities, depths[:, None])


@torch.no_grad()
def _radii(
    splats: Splats, opacities: Tensor, camera: Camera, config: RasterConfig, culling: Culling
) -> Int32[Tensor, "n 2"]:
    """Of the box around the ellipse on which alpha falls to `RasterConfig.alpha_min`, rounded up."""
    x, slope, y = splats.ellipse.unbind(1)
    extent = (2 * (opacities / config.alpha_min).log()).clamp_min(0).sqrt().clamp_max(_WIDEST)
    yy = 1 / (y * y)
    deviations = torch.stack([1 / (x * x) + slope * slope * yy, yy], dim=1).sqrt()
    radii = (extent[:, None] * deviations).ceil()
    size = radii.new_tensor([camera.width, camera.height])
    reaches = (splats.mean2d + radii > 0) & (splats.mean2d - radii < size)
    seen = reaches.all(1) & (radii > culling.radius).any(1) & (opacities >= config.alpha_min)
    seen &= (splats.depth > 0) & (splats.depth <= culling.far)
    return torch.where(seen[:, None], radii.clamp_max(_LARGEST), 0).int()


def compensation(
    splats: Splats,
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    camera: Camera,
    config: RasterConfig,
) -> Float[Tensor, " n"]:
    """Share of its opacity that a Gaussian keeps when it is blurred: sqrt(det S / det(S + eps I)), S its 2D covariance.

    This is the 2D filter of Mip-Splatting (Yu et al., CVPR 2024). The ellipse gives the second determinant. Not the first: where a Gaussian is far smaller than
    the blur, a difference of the two has no digits left. With t the clamped slopes x/z and y/z and d = (t, 1) in the Gaussian's own axes,
    det S = (fx fy / z^2)^2 |(s2 s3, s3 s1, s1 s2) * d|^2, which is the cross product of the projected axes. 1 where a Gaussian is culled.
    """
    drawn = splats.depth > 0
    viewmat, K = camera.viewmat.to(means), camera.K.to(means)
    focal, center = K.diagonal()[:2], K[:2, 2]
    size = means.new_tensor([camera.width, camera.height])
    margin = config.fov_margin * size / 2
    x = torch.where(drawn[:, None], means @ viewmat[:3, :3].T + viewmat[:3, 3], 1.0)
    z = x[:, 2:]
    slope = (x[:, :2] / z).clamp(-(center + margin) / focal, (size - center + margin) / focal)
    ray = slope @ viewmat[:2, :3] + viewmat[2, :3]
    upright = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    unit = normalize(torch.where(drawn[:, None], quats, upright), dim=1, eps=0)
    w, axis = unit[:, :1], unit[:, 1:]
    turn = torch.linalg.cross(axis, ray)
    ray = ray + 2 * (torch.linalg.cross(axis, turn) - w * turn)
    sides = scales.roll(-1, dims=1) * scales.roll(1, dims=1)
    area = (sides * ray).norm(dim=1) * (focal.prod() / z.square())[:, 0]
    inverse = splats.ellipse[:, 0] * splats.ellipse[:, 2]
    return torch.where(drawn, area * inverse, 1.0)
