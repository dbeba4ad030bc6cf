"""What most training views see outside of every mask says nothing: skies, and whatever else nobody segmented.

A pixel without a mask teaches no code, so that Gaussians which only such pixels see carry what rubbed off at the edges of masks and
from blended views, and answer to words by chance. One pixel cannot tell a sky from a mask that was missed. All views together can: masks are
missed in some views, and a sky has none in any.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.objectives.targets import covered
from vlgs.training.lift import gathered
from vlgs.training.lightning import VLGSModule

MAX_VIEWS = 64
"""Views that are asked, evenly chosen."""


@torch.no_grad()
def silence(module: VLGSModule, share: float) -> int:
    """Set the codes to zero of Gaussians that have more than `share` of their language weight outside of masks, in place.

    Weights are those with which language is blended, summed over the pixels of the training views; pixels that a photograph does
    not cover do not count. Every mask level is asked by itself.

    Returns:
        How many codes, of all Gaussians and levels, are zero now that were not.
    """
    features, levels = module.model.splats["features"], module.model.levels
    outside = outside_masks(module) > share
    codes = features.unflatten(1, (levels, -1))
    changed = outside & (codes != 0).any(dim=-1)
    codes[outside] = 0
    return int(changed.sum())


def outside_masks(module: VLGSModule) -> Float[Tensor, "n levels"]:
    """Share of a Gaussian's language weight that lies outside of masks; 0 where no view sees it."""
    model, views = module.model, module.views.scene.train
    with torch.no_grad():
        weight = model.fuse().language_weight
    levels = [weight] * model.levels if weight.dim() == 1 else list(weight.T.contiguous())
    total = torch.zeros(len(weight), model.levels, 2)
    for index in range(0, len(views), -(-len(views) // MAX_VIEWS)):
        target, seen = module.views[index], covered(views[index])
        if not target.has_language:
            continue
        for level, own in enumerate(levels):
            image = _outside_and_all(target.valid[:, level :: len(levels)], seen)
            total[:, level] += gathered(model, views[index].camera, own, image)
    outside, everywhere = total.unbind(-1)
    return outside / everywhere.clamp_min(torch.finfo(total.dtype).tiny)


def _outside_and_all(
    masked: Bool[Tensor, "h w"], seen: Bool[Tensor, "h w"] | None
) -> Float[Tensor, "h w 2"]:
    there = torch.ones_like(masked) if seen is None else seen
    return torch.stack([there & ~masked, there], dim=-1).float()
