"""The share of an unseen view that is drawn by Gaussians which hardly any training view sees."""

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields.splat import SplatModel
from vlgs.ops.rasterize import rasterize
from vlgs.types import Camera, ChannelGroup, Scene

SEEN = 0.1
"""A view sees a Gaussian that has this weight in it, summed over pixels: a tenth of one pixel."""
FEW = 2
"""Gaussians that fewer training views see are lonely."""


@torch.no_grad()
def share_lonely(model: SplatModel, scene: Scene) -> float:
    """Share of the held-out pixels of which more than half of the colour comes from lonely Gaussians."""
    seen = sum((view_weights(model, view.camera) > SEEN).int() for view in scene.train)
    assert isinstance(seen, Tensor)
    lonely = (seen < FEW).float()[:, None]
    opacity = model.gaussians().opacities
    covered = [model.render_values(view.camera, lonely, opacity) > 0.5 for view in scene.test]
    return float(torch.cat([pixels.flatten() for pixels in covered]).float().mean())


def view_weights(model: SplatModel, camera: Camera) -> Float[Tensor, " n"]:
    """Weight of every Gaussian in the colour of one view, summed over pixels: what it has after all before it.

    An image of ones is linear in the values that are blended, so that its gradient by them is these weights.
    """
    gaussians = model.gaussians()
    with torch.enable_grad():
        ones = torch.ones(model.count, 1, requires_grad=True)
        group = ChannelGroup(ones, gaussians.opacities.detach())
        image = rasterize(
            gaussians.means.detach(),
            gaussians.quats.detach(),
            gaussians.scales.detach(),
            [group],
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            config=model.raster,
        ).images[0]
        (weights,) = torch.autograd.grad(image.sum(), ones)
    return weights[:, 0]
