"""Photographs of different exposure: the maps take the difference, the scene keeps its colour."""

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from tiny_runs import TINY, composed
from torch import Tensor

from vlgs.config import instantiate
from vlgs.runs import RunFolder
from vlgs.training.build import Parts, build_module
from vlgs.training.exposure import Exposure
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.types import Scene, View

GAINS = (0.6, 1.0)


def exposed(scene: Scene) -> Scene:
    """Every second photograph is dark."""

    def dark(view: View, gain: float) -> View:
        return replace(view, read_image=lambda: (view.read_image() * gain).to(torch.uint8))

    return replace(scene, train=tuple(dark(v, GAINS[i % 2]) for i, v in enumerate(scene.train)))


def module_of(*overrides: str) -> VLGSModule:
    config = composed(
        *TINY, "trainer=smoke", "data.cache=null", "fusion=none", "blend=none", *overrides
    )
    torch.manual_seed(0)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(exposed(instantiate(config.data)), parts, 0)


def trained(folder: Path, *overrides: str) -> VLGSModule:
    module = module_of("trainer.exposure=true", "trainer.learning_rates.exposure=0.02", *overrides)
    fit(module, RunFolder(folder), FitOptions(meta={}, progress=False))
    return module


def test_maps_are_the_identity_on_average():
    exposure, color = Exposure(3), torch.rand(2, 2, 3)
    torch.testing.assert_close(exposure(1, color), color)
    with torch.no_grad():
        exposure.maps.copy_(torch.randn(3, 3, 4))
    mean = torch.stack([exposure(i, color) for i in range(3)]).mean(dim=0)
    torch.testing.assert_close(mean, color)


@pytest.mark.usefixtures("unchecked")
def test_dark_photographs_have_dark_maps(tmp_path: Path):
    module = trained(tmp_path, "trainer.iterations=150")
    assert module.step.exposure is not None
    grey = torch.full((1, 1, 3), 0.5)
    shown: Tensor = torch.stack([module.step.exposure(i, grey).mean() for i in range(6)]).detach()
    dark, bright = shown[0::2], shown[1::2]
    assert (dark < 0.9 * bright.min()).all()
    assert abs(float(dark.mean() / bright.mean()) - 0.6) < 0.15


@pytest.mark.usefixtures("unchecked")
def test_a_resumed_run_has_the_same_maps(tmp_path: Path):
    # What depends on the budget is switched off: the first half is a run of its own.
    budget = ("trainer.iterations=12", "trainer.means_steps=12", "gaussians.silent_above=1.0")
    whole = trained(tmp_path / "whole", *budget)
    half = module_of("trainer.exposure=true", "trainer.learning_rates.exposure=0.02", *budget)
    half.settings = replace(half.settings, iterations=6)
    fit(half, RunFolder(tmp_path / "halves"), FitOptions(meta={}, progress=False))
    resumed = trained(tmp_path / "halves", *budget)
    assert whole.step.exposure is not None
    assert resumed.step.exposure is not None
    assert whole.step.exposure.maps.abs().sum() > 0
    assert torch.equal(whole.step.exposure.maps, resumed.step.exposure.maps)
    assert torch.equal(whole.model.splats["means"], resumed.model.splats["means"])
