"""Colour and language as two sets of Gaussians that share nothing (``sharing=none``; conf/README.md, D.16)."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from vlgs.demands import has
from vlgs.fields.splat import SplatModel
from vlgs.fusion.none import NoFusion
from vlgs.indicator import Learned, Trained
from vlgs.training.build import Parts
from vlgs.types import Scene

NOWHERE = -100.0
"""Logit of a weight that is exactly 0 in float32."""


def without_language(scene: Scene) -> Scene:
    """The scene without its language supervision."""
    return replace(
        scene,
        train=tuple(replace(view, read_masks=None) for view in scene.train),
        mask_vectors=scene.mask_vectors[:0],
        mask_areas=scene.mask_areas[:0],
        mask_levels=1,
    )


def for_language(parts: Parts) -> Parts:
    """What a set of Gaussians for language alone is trained with.

    Its one weight is the indicator, which therefore takes the opacity's place in pruning and resets; without colour there are
    no harmonics, and no colour loss that densification could go by.
    """
    config = parts.gaussians
    config = replace(
        config,
        color="rgb",
        prune_on="indicator",
        densify_on="total",
        densify=replace(config.densify, reset_indicator=True),
    )
    indicator = parts.indicator if has(parts.indicator, "without_color") else Learned()
    if isinstance(indicator, Trained):
        indicator = replace(indicator, reach=0.0)  # no colour sees these Gaussians
    return replace(parts, gaussians=config, indicator=indicator)


@torch.no_grad()
def unite(color: SplatModel, language: SplatModel) -> SplatModel:
    """Join both sets in one model that renders the same bits. Each Gaussian has weight 0 in the other modality.

    Args:
        color: Renders colour.
        language: Renders language; not fused.
    """
    ours, theirs = dict(color.splats), dict(language.splats)
    n, m = color.count, language.count
    theirs["shN"] = ours["shN"].new_zeros(m, *ours["shN"].shape[1:])
    theirs["opacity_logits"] = torch.full((m,), NOWHERE)
    levels = theirs["indicator_logits"].shape[1:]
    ours["indicator_logits"] = torch.full((n, *levels), NOWHERE)
    ours["features"] = torch.zeros(n, theirs["features"].shape[1])
    indicator = language.indicator
    if has(indicator, "untrained"):
        # A weight of exactly 1 has an infinite logit, which no file may hold.
        weight = indicator(language.gaussians())
        theirs["indicator_logits"] = weight.logit().clamp(NOWHERE, -NOWHERE)
        indicator = Learned()
    both: dict[str, Tensor] = {name: torch.cat([ours[name], theirs[name]]) for name in ours}
    model = SplatModel(
        both,
        NoFusion(),
        indicator,
        language.head,
        color.raster,
        color.sh_degree,
        attributes={**language.attributes, "shN": color.attributes["shN"]},
    )
    model.splats = nn.ParameterDict({k: nn.Parameter(v, False) for k, v in both.items()})
    return model
