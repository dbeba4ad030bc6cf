"""Pixels that no mask claims are drawn to the code of nothing."""

from dataclasses import fields

import pytest
import torch
from tiny_runs import TINY, composed

from vlgs.config import instantiate
from vlgs.module.build import Parts, build_module


def lengths(weight: float) -> tuple[float, float]:
    """Mean length of the rendered codes outside and inside of the masks of a training view under a sky, after a short training."""
    given = ("trainer=smoke", "data.scene=mirrors_sky", "fusion=none", "gaussians.background=300")
    config = composed(*TINY, *given, "data.cache=null", f"loss.absent_weight={weight}")
    torch.manual_seed(0)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    module = build_module(instantiate(config.data), parts, 0)
    for step in range(60):
        module.training_step(step, step)
    target = module.target(0)
    assert target.valid is not None
    feature = module.model.render(target.view.camera, color=False).feature
    assert feature is not None
    length = feature.detach().norm(dim=-1)
    return length[~target.valid].mean().item(), length[target.valid].mean().item()


def test_a_sky_without_masks_carries_no_language():
    (outside, inside), (untaught, without) = lengths(0.5), lengths(0.0)
    assert outside < 0.7 * untaught
    assert inside == pytest.approx(without, rel=0.15)
