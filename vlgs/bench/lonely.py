"""The share of an unseen view that is drawn by Gaussians which hardly any training view sees."""

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields.splat import SplatModel
from vlgs.training.lift import gathered
from vlgs.types import Camera, Scene

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
    """Weight of every Gaussian in the colour of one view, summed over pixels: what it has after all before it."""
    ones = torch.ones(camera.height, camera.width, 1)
    opacities = model.gaussians().opacities.detach()
    return gathered(model, camera, opacities, ones, of_color=True)[:, 0]
