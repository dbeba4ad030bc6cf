"""How much the training views show of every Gaussian: its blending weights, summed over the pixels of each view.

Densification leaves many behind that no photograph needs, such as clones behind their originals. Niemeyer et al. 2024 ("RadSplat") remove those
whose largest weight in any pixel is small; here those go that fill less than a fraction of a pixel in every view
(`vlgs.gaussians.DensifyConfig.prune_unseen`), whatever their opacity.
"""

from math import ceil, sqrt

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.geometry import subsample_camera
from vlgs.objectives.targets import covered
from vlgs.training.lift import gathered_each
from vlgs.training.lightning import VLGSModule

PIXELS = 1 << 24
"""Most that are looked at in all views together. Larger ones are sampled, every n-th pixel of every n-th row of each view: the more views there
are, the more often the samples of one meet what those of another miss."""


@torch.no_grad()
def most_shown(module: VLGSModule) -> Float[Tensor, " n"]:
    """Per Gaussian, of the training view that shows most of it, the sum of its blending weights over pixels: how many pixels it fills.

    Weights are those that keep a Gaussian alive (`vlgs.gaussians.GaussiansConfig.prune_on`): of colour, of language, or whichever shows more.
    Pixels that a photograph does not cover do not count.
    """
    model, views = module.model, module.views.scene.train
    fused, prune_on = model.fuse(), module.densifying.config.prune_on
    weights: list[tuple[Tensor, bool]] = []
    if prune_on != "indicator":
        weights.append((fused.gaussians.opacities, True))
    if prune_on != "opacity":
        levels = fused.language_weight.view(model.count, -1).T.contiguous()
        weights += [(weight, False) for weight in levels]
    pixels = sum(view.camera.width * view.camera.height for view in views)
    step = max(1, ceil(sqrt(pixels / PIXELS)))
    most = torch.zeros(model.count)
    for view in views:
        camera, seen = subsample_camera(view.camera, step), covered(view)
        image = torch.ones(camera.height, camera.width, 1)
        if seen is not None:
            image *= seen[::step, ::step, None]
        for shown in gathered_each(model, camera, weights, image, step):
            most = most.maximum(shown[:, 0])
    return most * step**2
