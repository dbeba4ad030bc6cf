"""What lies outside of all masks says nothing in the end; what one view missed keeps its word."""

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from slow import with_slow
from tiny_runs import TINY, composed
from torch import Tensor

from vlgs.config import instantiate
from vlgs.runs import RunFolder
from vlgs.training.build import Parts, build_module
from vlgs.training.fit import FitOptions, fit
from vlgs.training.joint import join_levels
from vlgs.training.lightning import VLGSModule
from vlgs.training.silence import outside_masks, silence
from vlgs.types import Scene


def module_of(scene: Scene | None, *overrides: str) -> VLGSModule:
    given = (
        "trainer=smoke",
        "data.scene=mirrors_sky",
        "gaussians.background=300",
        "data.cache=null",
    )
    config = composed(*TINY, *given, *overrides)
    torch.manual_seed(0)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(instantiate(config.data) if scene is None else scene, parts, 0)


@torch.no_grad()
def named(module: VLGSModule) -> VLGSModule:
    """Every Gaussian has a code and a weight of its own."""
    draws = torch.Generator().manual_seed(1)
    for name in ("features", "indicator_logits"):
        value = module.model.splats[name]
        value.copy_(torch.randn(value.shape, generator=draws))
    return module


def share_by_rendering(module: VLGSModule) -> Tensor:
    """`outside_masks` of one level, from pictures in which every Gaussian has a channel of its own."""
    model, weight = module.model, module.model.gaussians().indicators.detach()
    total = torch.zeros(model.count, 2)
    for view in module.views.scene.train:
        assert view.read_masks is not None
        with torch.no_grad():
            own = model.render_values(view.camera, torch.eye(model.count), weight)
        outside = view.read_masks().reshape(own.shape[:2]) < 0
        total += torch.stack([own[outside].sum(dim=0), own.flatten(0, 1).sum(dim=0)], dim=1)
    return total[:, 0] / total[:, 1].clamp_min(1e-30)


def test_shares_are_those_of_rendering_each_gaussian():
    module = named(module_of(None))
    torch.testing.assert_close(
        outside_masks(module)[:, 0], share_by_rendering(module), rtol=1e-4, atol=1e-5
    )


def test_above_the_share_and_nowhere_else_codes_are_zero():
    module = named(module_of(None))
    share, before = outside_masks(module)[:, 0], module.model.splats["features"].detach().clone()
    gone = share > 0.7
    assert 50 < gone.sum() < len(gone) - 50  # sky, and things
    assert silence(module, 0.7) == gone.sum()
    after = module.model.splats["features"]
    assert not after[gone].any()
    assert torch.equal(after[~gone], before[~gone])
    assert silence(module, 0.7) == 0


def test_pixels_that_no_photograph_covers_do_not_count():
    scene = module_of(None).views.scene
    assert scene.train[0].read_masks is not None
    shape = scene.train[0].read_masks().shape[:2]
    nothing = torch.zeros(shape, dtype=torch.bool)
    scene = replace(scene, train=tuple(replace(v, read_valid=lambda: nothing) for v in scene.train))
    assert not outside_masks(named(module_of(scene))).any()


@pytest.mark.parametrize("indicator", with_slow(["learned", "per_level"], ["learned"]))
def test_every_level_is_asked_by_itself(indicator: str):
    scenes = [module_of(None, f"data.level={level}").views.scene for level in (1, 2, 3)]
    blank = tuple(
        replace(view, read_masks=lambda masks=view.read_masks: torch.full_like(masks(), -1))
        for view in scenes[1].train
        if view.read_masks is not None
    )
    joint = join_levels([scenes[0], replace(scenes[1], train=blank), scenes[2]])
    module = named(module_of(joint, "levels=joint", f"indicator={indicator}"))
    silence(module, 0.7)
    codes = module.model.splats["features"].unflatten(1, (3, -1)).detach()
    silent = ~codes.any(dim=-1)
    seen = outside_masks(module)[:, 1] > 0
    assert silent[seen, 1].all()
    assert not silent[:, 0].all()
    assert not silent[:, 2].all()


@pytest.mark.parametrize("share", [0.7, 1.0])
@pytest.mark.usefixtures("unchecked")
def test_the_end_of_training_is_when_it_happens(tmp_path: Path, share: float):
    module = module_of(None, f"gaussians.silent_above={share}", "trainer.iterations=30")
    fit(module, RunFolder(tmp_path), FitOptions(meta={}, progress=False))
    gone = outside_masks(module)[:, 0] > 0.7
    assert gone.sum() > 50
    assert module.model.splats["features"][gone].any() == (share == 1)
