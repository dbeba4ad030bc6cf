"""sharing=none: two sets of Gaussians that know nothing of each other."""

from dataclasses import fields
from pathlib import Path

import pytest
import torch
from slow import with_slow
from tiny_runs import TINY, composed

from vlgs.config import instantiate
from vlgs.indicator import Learned
from vlgs.runs import RunFolder
from vlgs.training.build import Parts, build_module
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.training.separate import for_language, unite, without_language
from vlgs.types import Scene


def trained(scene: Scene, folder: Path, color: bool, *overrides: str) -> VLGSModule:
    config = composed(
        *TINY,
        "trainer=smoke",
        "trainer.iterations=30",
        "sharing=none",
        "fusion=none",
        "gaussians.densify={start: 2, stop: 30, every: 8, reset_every: 13}",
        "gaussians.densify.grad_threshold=1e-5",
        *overrides,
    )
    torch.manual_seed(0)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    module = (
        build_module(without_language(scene), parts, 0)
        if color
        else build_module(scene, for_language(parts), 0, color=False)
    )
    fit(module, RunFolder(folder / str(color)), FitOptions(meta={}, progress=False))
    return module


@pytest.mark.parametrize(
    "indicator",
    with_slow(
        [
            "learned",
            "learned indicator.reach=10.0",
            "opacity",
            "fixed",
            "fixed indicator.value=1.0",
        ],
        ["learned indicator.reach=10.0", "opacity", "fixed", "fixed indicator.value=1.0"],
    ),
)
def test_the_united_model_renders_what_each_set_does(
    tiny_scene: Scene, tmp_path: Path, indicator: str
):
    color = trained(tiny_scene, tmp_path, True)
    language = trained(tiny_scene, tmp_path, False, *f"indicator={indicator}".split())
    assert color.model.count != language.model.count, "both must have densified on their own"
    both = unite(color.model, language.model)
    camera = tiny_scene.test[0].camera
    got = both.render(camera)
    image = color.model.render(camera, language=False).color
    code = language.model.render(camera, color=False).feature
    assert got.color is not None
    assert image is not None
    assert code is not None
    assert torch.equal(got.color, image)
    assert code.abs().max() > 0
    torch.testing.assert_close(got.feature, code, rtol=0, atol=1e-6)
    if indicator == "learned":  # as it is opened again, where the configuration has a reach
        both.indicator = Learned(reach=10.0)
        torch.testing.assert_close(both.render(camera).feature, got.feature, rtol=0, atol=0)
    assert both.count == color.model.count + language.model.count
    assert all(value.isfinite().all() for value in both.splats.values())


def test_language_alone_moves_its_weight_and_never_its_colour(tiny_scene: Scene, tmp_path: Path):
    module = trained(tiny_scene, tmp_path, False, "gaussians.densify.stop=0")
    splats, n = module.model.splats, len(tiny_scene.points)
    start = module_start(tiny_scene)
    assert module.model.count == n == len(start["sh0"])
    moved = {name for name in splats if not torch.equal(splats[name], start[name])}
    assert moved == {"means", "quats", "log_scales", "indicator_logits", "features"}


def module_start(scene: Scene) -> torch.nn.ParameterDict:
    config = composed(*TINY, "trainer=smoke", "fusion=none")
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, for_language(parts), 0, color=False).model.splats


def test_gaussians_of_language_live_by_their_indicator(tiny_scene: Scene, tmp_path: Path):
    module = trained(tiny_scene, tmp_path, False)
    from vlgs.gaussians import DensifyState, densify

    with torch.no_grad():
        module.model.splats["opacity_logits"].fill_(-9.0)
        module.model.splats["indicator_logits"].fill_(0.0)
        module.model.splats["indicator_logits"][5] = -9.0
    n = module.model.count
    state = DensifyState.zeros(n)
    config = module.densifying.config
    report = densify(module.model.splats, module.optimizer, state, config, 1.0, 0, 8)
    assert report.pruned == 1


def test_the_scene_of_colour_has_no_language(tiny_scene: Scene):
    silent = without_language(tiny_scene)
    assert len(silent.mask_vectors) == len(silent.mask_areas) == 0
    assert all(view.read_masks is None for view in silent.train)
    assert silent.mask_vectors.shape[1] == tiny_scene.mask_vectors.shape[1]
