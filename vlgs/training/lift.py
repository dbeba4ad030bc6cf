"""Language codes lifted from the training views onto Gaussians, without training."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields.splat import SplatModel
from vlgs.training.lightning import VLGSModule
from vlgs.types import Camera


def lift_features(module: VLGSModule) -> None:
    """Start the codes at ``f_i = sum_p w_ip H_p / sum_p w_ip`` over the masked pixels p of all training views, in place.

    w_ip is the blending weight of Gaussian i at pixel p. Gaussians that no masked pixel sees keep the code they have. One backward
    pass per view and mask level, as the sums are the gradient of the image by what is blended.
    """
    features, levels = module.model.splats["features"], module.model.levels
    with torch.no_grad():
        weight = module.model.fuse().language_weight
    weights = [weight] * levels if weight.dim() == 1 else [w.contiguous() for w in weight.unbind(1)]
    total = features.new_zeros(levels, len(features), features.shape[1] // levels + 1)
    for index, view in enumerate(module.views.scene.train):
        target = module.views[index]
        if not target.has_language:
            continue
        seen = target.valid[..., None].to(features)
        image = torch.cat([target.codes * seen, seen], dim=-1)
        for level, own in enumerate(weights):
            total[level] += gathered(
                module.model, view.camera, own, image[:, level::levels].contiguous()
            )
    with torch.no_grad():
        codes = features.unflatten(1, (levels, -1)).transpose(0, 1)
        lifted = total[..., :-1] / total[..., -1:].clamp_min(torch.finfo(total.dtype).tiny)
        lifted = torch.where(total[..., -1:] > 0, lifted, codes)
        features.copy_(lifted.transpose(0, 1).flatten(1))


def gathered(
    model: SplatModel,
    camera: Camera,
    weight: Float[Tensor, " n"],
    image: Float[Tensor, "h w c"],
    of_color: bool = False,
    step: int = 1,
) -> Float[Tensor, "n c"]:
    """Per Gaussian the sum over pixels of its blending weight times the image.

    Args:
        model: Whose Gaussians.
        camera: Of the image.
        weight: What blends, in [0, 1].
        image: What is summed.
        of_color: In the shapes of colour, not of language.
        step: Of the camera, where it is every `step`-th pixel of another (`SplatModel.render_values`).
    """
    return gathered_each(model, camera, [(weight, of_color)], image, step)[0]


def gathered_each(
    model: SplatModel,
    camera: Camera,
    weights: Sequence[tuple[Float[Tensor, " n"], bool]],
    image: Float[Tensor, "h w c"],
    step: int = 1,
) -> tuple[Float[Tensor, "n c"], ...]:
    """Likewise for several weights, each with its `of_color`."""
    values = [own.new_zeros(len(own), image.shape[-1], requires_grad=True) for own, _ in weights]
    with torch.enable_grad():
        groups = [(one, *own) for one, own in zip(values, weights, strict=True)]
        rendered = model.render_each(camera, groups, step)
        # The gradient of one number, for the reason that `sums_back` gives.
        total = torch.stack([(one * image).sum() for one in rendered]).sum()
    return torch.autograd.grad(total, values)


def sums_back(
    rendered: Float[Tensor, "h w c"], values: Float[Tensor, "n c"], image: Float[Tensor, "h w c"]
) -> Float[Tensor, "n c"]:
    """Per Gaussian the sum over pixels of its weight in `rendered`, which was blended from `values`, times `image`."""
    # The gradient of one number, as torch.autograd.grad imports sympy, 0.3 s of CPU, to compare the shapes of several.
    with torch.enable_grad():
        total = (rendered * image).sum()
    return torch.autograd.grad(total, values)[0]
