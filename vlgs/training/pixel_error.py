"""Which Gaussians stand where a render is wrong: the errors of the pixels that each of them blends."""

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.gaussians.draws import seeded_generator
from vlgs.training.lightning import VLGSModule

VIEWS = 10
"""Training views that are asked, drawn anew each time: a twentieth of the work of the hundred iterations between two densifications."""


def pixel_error(module: VLGSModule, step: int) -> Float[Tensor, " n"]:
    """Per Gaussian the sum, over the pixels of some training views, of its blending weight times the error of colour.

    Rota Bulo et al. 2024 ("Revising Densification in Gaussian Splatting") choose by it what is split; here it scales the gradients
    of 3DGS (`vlgs.gaussians.DensifyConfig.by_error`).

    Args:
        module: What is trained.
        step: Iteration that was done last; the draw of the views is a function of it and of the run's seed.
    """
    model = module.model
    with torch.no_grad():
        fused = model.fuse()
    weight = fused.gaussians.opacities
    cameras, generator = (
        module.step.views(step).scene.train,
        seeded_generator("pixel error", module.seed, step),
    )
    total = torch.zeros_like(weight)
    for index in torch.randperm(len(cameras), generator=generator)[:VIEWS].tolist():
        error = module.step.color_error(index, step, fused)
        values = weight.new_zeros(len(weight), 1, requires_grad=True)
        image = model.render_values(cameras[index].camera, values, weight, of_color=True)
        (sums,) = torch.autograd.grad(image, values, error[..., None])
        total += sums[:, 0]
    return total
