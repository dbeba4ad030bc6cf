"""Which Gaussians stand where a render is wrong: the errors of the pixels that each of them blends."""

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.gaussians.draws import seeded_generator
from vlgs.training.lift import gathered
from vlgs.training.lightning import VLGSModule

VIEWS = 10
"""Training views that are asked, drawn anew each time: 30 passes over the tiles, where the hundred iterations of `trainer=photos` between two densifications make 400 of colour, and the 45 of `trainer=fast` 180."""


@torch.no_grad()
def pixel_error(module: VLGSModule, step: int) -> Float[Tensor, " n"]:
    """Per Gaussian the sum, over the pixels of some training views, of its blending weight times the error of colour.

    Rota Bulo et al. 2024 ("Revising Densification in Gaussian Splatting") choose by it what is split; here it scales the gradients
    of 3DGS (`vlgs.gaussians.DensifyConfig.by_error`).

    Args:
        module: What is trained.
        step: Iteration that was done last; the draw of the views is a function of it and of the run's seed.
    """
    fused = module.model.fuse()
    weight, views = fused.gaussians.opacities, module.step.views(step).scene.train
    generator = seeded_generator("pixel error", module.seed, step)
    total = torch.zeros_like(weight)
    for index in torch.randperm(len(views), generator=generator)[:VIEWS].tolist():
        error = module.step.color_error(index, step, fused)[..., None]
        total += gathered(module.model, views[index].camera, weight, error, of_color=True)[:, 0]
    return total
