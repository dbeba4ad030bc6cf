"""Leaves Gaussians out of an iteration, drawn anew for each, so that few views are not explained by Gaussians that only one of them needs."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from vlgs.fields.splat import FusedGaussians


def leave_out(fused: FusedGaussians, share: float, rng: np.random.Generator) -> FusedGaussians:
    """Gaussians of which some have no weight, in colour and language, and the others so much more, up to 1, that the mean over draws is what it was.

    After Park et al. 2025 (DropGaussian). Where few views look, each is easily explained by Gaussians before its own camera. With these left out now
    and then, what lies behind them has to be right by itself.

    Args:
        fused: Of an iteration, all of whose views leave out the same.
        share: Of the Gaussians, each by a draw of its own; in [0, 1).
        rng: Draws them.
    """
    opacities, language = fused.gaussians.opacities, fused.language_weight
    kept = torch.from_numpy(rng.random(len(opacities), dtype=np.float32) >= share)

    def left(weight: Tensor) -> Tensor:
        factor = kept / (1 - share)
        return (weight * (factor if weight.dim() == 1 else factor[:, None])).clamp(max=1)

    own = left(opacities)
    # Groups of the very same weights share their transmittance.
    language = own if language is opacities else left(language)
    gaussians = replace(fused.gaussians, opacities=own)
    return replace(fused, gaussians=gaussians, language_weight=language)
