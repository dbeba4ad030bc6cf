"""Language codes lifted from the training views onto Gaussians, without training (systems.md D.9, F.4)."""

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.module.lightning import VLGSModule


def lift_features(module: VLGSModule) -> None:
    """Start the codes at ``f_i = sum_p w_ip H_p / sum_p w_ip`` over the masked pixels p of all training views, in place.

    w_ip is the blending weight of Gaussian i at pixel p. Gaussians that no masked pixel sees keep the code they have. One backward
    pass per view, as the sums are the gradient of the image by what is blended.
    """
    features = module.model.splats["features"]
    with torch.no_grad():
        weight = module.model.fuse().language_weight
    total = features.new_zeros(len(features), features.shape[1] + 1)
    for index in range(len(module.scene.train)):
        target = module.target(index)
        if target.codes is None or target.valid is None:
            continue
        seen = target.valid[..., None].to(features)
        total += _gathered(module, index, weight, torch.cat([target.codes * seen, seen], dim=-1))
    with torch.no_grad():
        lifted = total[:, :-1] / total[:, -1:].clamp_min(torch.finfo(total.dtype).tiny)
        features.copy_(torch.where(total[:, -1:] > 0, lifted, features))


def _gathered(
    module: VLGSModule, index: int, weight: Float[Tensor, " n"], image: Float[Tensor, "h w c"]
) -> Float[Tensor, "n c"]:
    """Per Gaussian the sum over pixels of its blending weight times the image."""
    values = weight.new_zeros(len(weight), image.shape[-1], requires_grad=True)
    camera = module.scene.train[index].camera
    rendered = module.model.render_values(camera, values, weight)
    return torch.autograd.grad(rendered, values, image)[0]
