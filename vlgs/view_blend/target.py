"""The language map that the blended view should see (Eq. 11)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.view_blend.ratio import ViewBlend


def blend_targets(
    codes1: Float[Tensor, "h w d"],
    valid1: Bool[Tensor, "h w"],
    codes2: Float[Tensor, "h w d"],
    valid2: Bool[Tensor, "h w"],
    k: float,
    blend: ViewBlend,
) -> tuple[Float[Tensor, "h w d"], Bool[Tensor, "h w"]]:
    """Mix two language maps pixel by pixel without warping: ``H_b = k H1 + (1 - k) H2``, and say which pixels have a code.

    With ``mask="or"`` a pixel that only one view has a code for takes that code. The mix of two unit codes is shorter than
    1; ``renormalise`` stretches it to ``k |H1| + (1 - k) |H2|``, which is 1 for unit codes (conf/README.md, D.5).

    Args:
        codes1: Language codes of view 1; what stands at pixels that are not valid is not used.
        valid1: Pixels of view 1 that have a code.
        codes2: Language codes of view 2.
        valid2: Pixels of view 2 that have a code.
        k: Weight of view 1.
        blend: The mask and renormalise switches.

    Raises:
        ValueError: If the maps differ in shape.
    """
    shapes = (codes1.shape, codes2.shape, (*valid1.shape, codes1.shape[-1]))
    if shapes[0] != shapes[1] or shapes[0] != shapes[2] or valid1.shape != valid2.shape:
        raise ValueError(
            f"blend_targets: both maps and masks must have one size, got {tuple(codes1.shape)}, {tuple(valid1.shape)}, "
            f"{tuple(codes2.shape)}, {tuple(valid2.shape)}"
        )
    target = torch.lerp(codes2, codes1, k)
    if blend.renormalise:
        length = torch.lerp(_length(codes2), _length(codes1), k)
        # Opposite codes cancel: where nothing is left there is no direction to stretch, and zero stays zero.
        target = target * (length / _length(target).clamp_min(torch.finfo(target.dtype).tiny))
    if blend.mask == "and":
        return target, valid1 & valid2
    target = torch.where((valid1 & ~valid2)[..., None], codes1, target)
    target = torch.where((valid2 & ~valid1)[..., None], codes2, target)
    return target, valid1 | valid2


def _length(codes: Float[Tensor, "h w d"]) -> Float[Tensor, "h w 1"]:
    return codes.norm(dim=-1, keepdim=True)
