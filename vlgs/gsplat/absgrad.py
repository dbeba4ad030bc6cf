"""Gradients of centres that do not cancel: over the pixels their sizes are summed (Ye et al., AbsGS, 2024), as gsplat's ``absgrad``.

The kernel sums over the pixels as it goes. Here the weights are formed one by one, in float64 and by torch, at the time of the
backward pass: exact, and some eighty times slower than the kernel.
"""

from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.gsplat.view import ViewSplats
from vlgs.ops.pixel_weights import pixel_weights
from vlgs.types import Camera, RasterConfig, Rendered


def watch(
    out: Rendered,
    view: ViewSplats,
    camera: Camera,
    config: RasterConfig,
    absgrad: Float[Tensor, "n 2"],
) -> tuple[Float[Tensor, "h w x"], Float[Tensor, "h w"]]:
    """Image and accumulated weight as they are; their backward pass writes `absgrad` first."""
    seen = cast(tuple[Tensor, Tensor], _Watch.apply(out.images[0], out.alphas[0], view, camera, config, absgrad))  # fmt: skip
    return seen


class _Watch(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, alpha: Tensor, view: ViewSplats, *rest: Any):
        ctx.view, (ctx.camera, ctx.config, ctx.absgrad) = view.detach(), rest
        return image.view_as(image), alpha.view_as(alpha)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        d_image, d_alpha = grad_outputs
        found = absolute_gradient(ctx.view, ctx.camera, ctx.config, d_image, d_alpha)
        ctx.absgrad.copy_(found)
        return d_image, d_alpha, None, None, None, None


@torch.no_grad()
def absolute_gradient(
    view: ViewSplats,
    camera: Camera,
    config: RasterConfig,
    d_image: Float[Tensor, "h w x"],
    d_alpha: Float[Tensor, "h w"],
) -> Float[Tensor, "n 2"]:
    """Sum over pixels of the size of what each adds to the gradient of a centre, for x and y; csrc/README.md derives it."""
    values, opacities = view.values.double(), view.opacities.double()
    centers, ellipse = view.splats.mean2d.double(), view.splats.ellipse.double()
    d_pixels, d_covered = d_image.flatten(0, 1).double(), d_alpha.flatten().double()
    sums = torch.zeros(len(centers), 2, dtype=torch.float64)
    for part in pixel_weights(view.splats, view.opacities, camera, config):
        i, p = part.gaussian, part.pixel
        toward = (values[i] * d_pixels[p]).sum(dim=1) + d_covered[p]
        covered, seen = part.weight.cumsum(0), (part.weight * toward).cumsum(0)
        first, last = torch.searchsorted(p, p), torch.searchsorted(p, p, right=True) - 1
        before = covered - part.weight
        transmittance = 1 - (before - before[first])
        behind = seen[last] - seen

        dx, dy = p % camera.width + 0.5 - centers[i, 0], p // camera.width + 0.5 - centers[i, 1]
        inverse_x, slope, inverse_y = ellipse[i].unbind(1)
        u, v = inverse_x * (dx - slope * dy), inverse_y * dy
        alpha = opacities[i] * torch.exp(-0.5 * (u * u + v * v))
        pull = alpha * (transmittance * toward - behind / (1 - alpha).clamp_min(1e-9))
        pull = torch.where(alpha > config.alpha_max, 0, pull)  # the clamp passes no gradient
        by_x = (pull * inverse_x * u).abs()
        by_y = (pull * (inverse_y * v - inverse_x * slope * u)).abs()
        for axis, sizes in enumerate((by_x, by_y)):
            sums[:, axis] += torch.bincount(i, sizes, minlength=len(sums))
    return sums.to(view.opacities.dtype)
