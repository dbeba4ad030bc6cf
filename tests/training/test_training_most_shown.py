"""How much of every Gaussian the training views show, and what goes by it when densification ends."""

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from slow import with_slow
from tiny_runs import TINY, composed
from torch import Tensor

from vlgs.config import instantiate
from vlgs.gaussians import DensifyConfig
from vlgs.gaussians.densify import MIN_COUNT
from vlgs.runs import RunFolder
from vlgs.training import most_shown as module_under_test
from vlgs.training.build import Parts, build_module
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lift import gathered, gathered_each
from vlgs.training.lightning import VLGSModule
from vlgs.training.most_shown import most_shown
from vlgs.types import Scene

STOP = 12
GIVEN = (
    "trainer.iterations=20",
    "trainer.checkpoint_every=4",
    f"gaussians.densify={{start: 2, stop: {STOP}, every: 4, reset_every: 0}}",
    "gaussians.densify.grad_threshold=1e-6",
)
PRUNE = "gaussians.densify.prune_unseen"


def module_of(scene: Scene, *overrides: str) -> VLGSModule:
    config = composed(*TINY, "trainer=smoke", *GIVEN, *overrides)
    torch.manual_seed(0)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, 0)


def trained(module: VLGSModule, folder: Path, until: int | None = None) -> dict[int, int]:
    """Train, to the end or as if stopped by Ctrl-C; Gaussians that each iteration began with."""
    original, counts = module.training_step, {}

    def step(number: int, batch_idx: int) -> None:
        counts[number] = module.count
        original(number, batch_idx)
        if number + 1 == until:
            module.trainer.should_stop = True

    module.training_step = step  # type: ignore[method-assign]
    fit(module, RunFolder(folder), FitOptions(meta={}, progress=False))
    return counts


def parameters(module: VLGSModule) -> Mapping[str, Tensor]:
    return {name: parameter.detach() for name, parameter in module.step.trained()}


@torch.no_grad()
def images_of(module: VLGSModule, row: int, of_color: bool) -> list[Tensor]:
    """The image of a Gaussian that alone is white is its weight, whoever computes it."""
    fused, one = module.model.fuse(), torch.eye(module.count)[row][:, None]
    weight = fused.gaussians.opacities if of_color else fused.language_weight
    views = module.views.scene.train
    return [
        module.model.render_values(view.camera, one, weight, of_color=of_color)[..., 0]
        for view in views
    ]


def test_it_is_the_most_of_all_views_and_of_colour_and_language(tiny_scene: Scene):
    module = module_of(tiny_scene, "gaussians.init_opacity=0.6", "gaussians.init_indicator=0.3")
    shown = most_shown(module)
    for row in (0, 7, 150, 360):
        images = images_of(module, row, of_color=True) + images_of(module, row, of_color=False)
        want = torch.stack([image.sum() for image in images]).max()
        torch.testing.assert_close(shown[row], want, rtol=1e-4, atol=1e-5)
    assert shown.count_nonzero() > 100


@pytest.mark.parametrize("sharing", ["pos_cov", "pos"])
def test_colour_and_language_in_one_pass_are_what_they_are_alone(tiny_scene: Scene, sharing: str):
    module = module_of(tiny_scene, f"sharing={sharing}", "gaussians.init_indicator=0.3")
    model, camera = module.model, tiny_scene.train[0].camera
    if "language_log_scales" in model.splats:
        with torch.no_grad():
            model.splats["language_log_scales"] += 0.5
    fused, image = model.fuse(), torch.rand(camera.height, camera.width, 2)
    image[..., 1] = 1
    weights = [(fused.gaussians.opacities, True), (fused.language_weight, False)]
    both = gathered_each(model, camera, weights, image)
    view = model.render(camera, fused=fused)
    drawn = (view.alpha_color, view.alpha_language)
    for (weight, of_color), together, alpha in zip(weights, both, drawn, strict=True):
        assert torch.equal(gathered(model, camera, weight, image, of_color), together)
        assert alpha is not None
        torch.testing.assert_close(together[:, 1].sum(), alpha.detach().sum(), rtol=1e-4, atol=0)


@pytest.mark.parametrize("prune_on", ["opacity", "indicator"])
def test_weights_that_do_not_keep_a_gaussian_alive_do_not_count(tiny_scene: Scene, prune_on: str):
    chosen = ("gaussians.init_indicator=0.9", f"gaussians.prune_on={prune_on}")
    module = module_of(tiny_scene, *chosen)
    images = images_of(module, 7, of_color=prune_on == "opacity")
    want = torch.stack([image.sum() for image in images]).max()
    torch.testing.assert_close(most_shown(module)[7], want, rtol=1e-4, atol=1e-5)


def test_many_pixels_are_sampled(tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch):
    module = module_of(tiny_scene, "gaussians.prune_on=opacity", "gaussians.init_opacity=0.6")
    whole = most_shown(module)
    pixels = sum(v.camera.width * v.camera.height for v in tiny_scene.train)
    monkeypatch.setattr(module_under_test, "PIXELS", pixels // 4)
    sampled = most_shown(module)
    images = images_of(module, 7, of_color=True)
    want = torch.stack([4 * image[::2, ::2].sum() for image in images]).max()
    torch.testing.assert_close(sampled[7], want, rtol=1e-3, atol=1e-4)
    large = whole > 10
    assert large.sum() > 10
    torch.testing.assert_close(sampled[large], whole[large], rtol=0.2, atol=0)


def test_pixels_that_a_photograph_does_not_cover_do_not_count(tiny_scene: Scene):
    views = [
        replace(v, read_valid=lambda v=v: torch.arange(v.camera.width).expand(v.camera.height, -1) < 10)
        for v in tiny_scene.train
    ]  # fmt: skip
    module = module_of(replace(tiny_scene, train=tuple(views)), "gaussians.prune_on=opacity")
    shown = most_shown(module)
    for row in (0, 7, 150, 360):
        want = torch.stack([i[:, :10].sum() for i in images_of(module, row, of_color=True)]).max()
        torch.testing.assert_close(shown[row], want, rtol=1e-4, atol=1e-5)


@pytest.mark.usefixtures("unchecked")
def test_what_no_view_shows_goes_when_densification_ends(tiny_scene: Scene, tmp_path: Path):
    before = module_of(tiny_scene)
    trained(before, tmp_path / "before", until=STOP)
    bound = float(most_shown(before).quantile(0.3))
    module = module_of(tiny_scene, f"{PRUNE}={bound}")
    counts = trained(module, tmp_path / "after")
    kept = int((most_shown(before) >= bound).sum())
    assert counts[STOP - 1] == before.count > kept
    assert counts[STOP] == counts[19] == kept


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("until", with_slow([STOP - 1, STOP], [STOP]))
def test_it_resumes_to_the_bit(tiny_scene: Scene, tmp_path: Path, until: int):
    options = (f"{PRUNE}=0.5",)
    whole, first, second = (module_of(tiny_scene, *options) for _ in range(3))
    counts = trained(whole, tmp_path / "whole")
    assert counts[STOP - 1] > counts[STOP]
    trained(first, tmp_path / "parts", until=until)
    trained(second, tmp_path / "parts")
    for name, value in parameters(whole).items():
        assert torch.equal(value, parameters(second)[name]), name


@pytest.mark.usefixtures("unchecked")
def test_nothing_goes_where_no_iteration_is_left_to_mend_it(tiny_scene: Scene, tmp_path: Path):
    options = (f"{PRUNE}=0.5", f"trainer.iterations={STOP}")
    module = module_of(tiny_scene, *options)
    counts = trained(module, tmp_path / "run")
    assert module.count == counts[STOP - 1]


@pytest.mark.usefixtures("unchecked")
def test_a_scene_does_not_end_empty(tiny_scene: Scene, tmp_path: Path):
    module = module_of(tiny_scene, f"{PRUNE}=1000000")
    trained(module, tmp_path / "run")
    assert module.count == MIN_COUNT


def test_a_bound_below_nothing_is_refused():
    with pytest.raises(ValueError, match=r"densify: prune_unseen must be .*, got -1"):
        DensifyConfig(prune_unseen=-1.0)
