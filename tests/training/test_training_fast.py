"""What ``trainer=fast`` does: small views at first, large steps that slow down."""

import gc
import weakref
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from slow import with_slow
from tiny_runs import TINY, composed
from torch import Tensor

from vlgs.config import instantiate
from vlgs.experiment import construct
from vlgs.objectives.targets import TrainingViews
from vlgs.runs import RunFolder
from vlgs.training.build import Parts, build_module
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.training.settings import LearningRates, TrainerConfig
from vlgs.types import Scene

CODES = "gaussians.init_features=normal"

LESS = (
    "trainer.iterations=16",
    "trainer.half_size=0.5",
    "trainer.color_decay=0.1",
    "gaussians.densify={start: 2, stop: 15, every: 4, reset_every: 0}",
    "gaussians.densify.grad_threshold=1e-6",
)


def module_of(scene: Scene, *overrides: str) -> VLGSModule:
    config = composed(*TINY, "trainer=smoke", *overrides)
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, config.seed)


def trained(
    scene: Scene, folder: Path, *overrides: str, each: Callable[[VLGSModule], None] | None = None
) -> VLGSModule:
    module = module_of(scene, *overrides)
    original = module.training_step

    def step(number: int, batch_idx: int) -> None:
        original(number, batch_idx)
        if each is not None:
            each(module)

    module.training_step = step  # type: ignore[method-assign]
    fit(module, RunFolder(folder), FitOptions(meta={}, progress=False))
    return module


def test_where_no_shape_is_learned_all_views_keep_their_size(tiny_scene: Scene):
    frozen = "trainer.freeze=[means,quats,log_scales,sh0,shN,opacity_logits]"
    module = module_of(tiny_scene, *LESS, "gaussians.densify.stop=0", "fusion=none", frozen)
    assert module.step.views(0) is module.views  # whose kept weights serve


def test_views_are_small_in_the_first_half(tiny_scene: Scene, tmp_path: Path):
    sizes: list[set[tuple[int, int]]] = []
    seen: list[weakref.ref[TrainingViews]] = []

    def each(module: VLGSModule) -> None:
        report = module.report
        seen.append(weakref.ref(module.step.bound.views))
        sizes.append({(camera.width, camera.height) for camera in report.cameras})
        images = [render.color for render in report.renders]
        assert all(
            i is not None and i.shape == p.shape
            for i, p in zip(images, report.photographs, strict=True)
        )

    module = trained(tiny_scene, tmp_path, *LESS, each=each)
    assert seen[-1]() is module.views
    whole = tiny_scene.train[0].camera
    small = ((whole.width + 1) // 2, (whole.height + 1) // 2)
    assert sizes == [{small}] * 8 + [{(whole.width, whole.height)}] * 8
    gc.collect()
    assert seen[0]() is None  # what it had read is given up


@pytest.mark.parametrize("stop", with_slow([5, 8, 11], [5, 11]))
@pytest.mark.usefixtures("unchecked")
def test_stopped_before_at_and_after_the_change_it_goes_on_to_the_same_bits(
    tiny_scene: Scene, tmp_path: Path, stop: int
):
    whole = trained(tiny_scene, tmp_path / "whole", *LESS)

    def interrupt(module: VLGSModule) -> None:
        module.trainer.should_stop = module.next_step == stop

    first = trained(tiny_scene, tmp_path / "parts", *LESS, each=interrupt)
    assert first.next_step == stop
    second = trained(tiny_scene, tmp_path / "parts", *LESS)
    splats = whole.model.splats
    assert whole.model.count != len(tiny_scene.points)
    assert all(torch.equal(splats[name], second.model.splats[name]) for name in splats)


def test_rates_of_colour_and_shape_fall_along_half_a_cosine(tiny_scene: Scene):
    module = module_of(tiny_scene, *LESS, "trainer.learning_rates.quats=0.002")
    module.set_schedule(8)
    rates = {group["name"]: group["lr"] for group in module.optimizer.param_groups}
    given = LearningRates()
    for name in ("log_scales", "sh0", "shN", "opacity_logits"):
        assert rates[name] == pytest.approx(0.55 * getattr(given, name))
    assert rates["quats"] == pytest.approx(0.55 * 0.002)
    assert rates["features"] == given.features
    assert rates["means"] == pytest.approx(module.settings.means_rate(8) * module.densifying.extent)


def test_language_that_has_a_shape_of_its_own_learns_it_as_colour_does(tiny_scene: Scene):
    module = module_of(tiny_scene, *LESS, "sharing=pos", "trainer.rates_for=64")
    module.set_schedule(8)
    rates = {group["name"]: group["lr"] for group in module.optimizer.param_groups}
    assert rates["language_log_scales"] == rates["log_scales"]
    assert rates["language_quats"] == rates["quats"]


@pytest.mark.usefixtures("unchecked")
def test_large_views_make_more_gaussians_where_thresholds_fall_with_their_size(
    tiny_scene: Scene, tmp_path: Path
):
    def count(size: float) -> int:
        """After the first densification, of a run on views of 48x36, 41.6 pixels."""
        size_override = f"gaussians.densify.grad_threshold_size={size}"
        once = (
            "trainer.iterations=6",
            "trainer.half_size=0",
            "gaussians.densify.grad_threshold=1e-3",
        )
        module = trained(tiny_scene, tmp_path / str(size), *LESS, *once, size_override)
        return module.model.count

    whatever = count(0.0)
    assert count(42.0) == whatever
    assert count(0.1) > whatever


def test_a_count_that_is_full_is_told_once(
    tiny_scene: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    full = len(tiny_scene.points)
    room = "gaussians.background=0"
    trained(tiny_scene, tmp_path / "full", *LESS, room, f"gaussians.max_count={full}")
    (said,) = [r.getMessage() for r in caplog.records if "max_count" in r.getMessage()]
    assert said.startswith(f"iteration 4: gaussians.max_count={full} leaves no room for ")
    caplog.clear()
    trained(tiny_scene, tmp_path / "free", *LESS, room)
    assert "max_count" not in caplog.text


def test_rates_made_for_another_budget_grow_by_the_root(tiny_scene: Scene):
    plain, paced = (
        module_of(tiny_scene, *LESS, f"trainer.rates_for={made}") for made in ("null", 64)
    )
    for module in (plain, paced):
        module.set_schedule(8)
    rates, faster = (
        {group["name"]: group["lr"] for group in module.optimizer.param_groups}
        for module in (plain, paced)
    )
    for name in ("means", "quats", "log_scales", "sh0", "shN", "opacity_logits"):
        assert faster[name] == pytest.approx(2 * rates[name]), name  # sqrt(64 / 16)
    for name in ("features", "indicator_logits"):
        assert faster[name] == rates[name], name
    assert TrainerConfig(16, LearningRates(means_final=0.0), rates_for=16).pace == 1


def test_a_scaled_budget_is_the_one_that_is_written_out():
    written = (
        "trainer.iterations=3040",
        "trainer.sh_every=608",
        "gaussians.densify.start=202",
        "gaussians.densify.stop=2026",
        "gaussians.densify.every=122",
    )
    by_hand = construct(composed("trainer=fast_photos", *written)).make_parts()
    asked = construct(composed("trainer=fast_photos", "trainer.steps_scaler=2.0"))
    for parts in (asked.parts, asked.make_parts()):
        trainer = replace(parts.trainer, steps_scaler=1.0)
        assert (trainer, parts.gaussians) == (by_hand.trainer, by_hand.gaussians)
    small = construct(composed("trainer=paper", "trainer.steps_scaler=0.001")).parts
    assert small.trainer.iterations == 15
    assert small.gaussians.densify.every == 1  # not never


def test_a_scaled_budget_is_what_is_trained(tiny_scene: Scene):
    experiment = construct(composed(*TINY, "trainer=smoke", *LESS, "trainer.steps_scaler=0.5"))
    module = build_module(tiny_scene, experiment.make_parts(), experiment.seed)
    densify = module.densifying.config.densify
    assert (module.settings.iterations, densify.start, densify.stop) == (8, 1, 8)
    assert module.settings.is_half_size(3)
    assert not module.settings.is_half_size(4)


def test_training_views_are_blended_to_an_earlier_stop_and_results_are_not(tiny_scene: Scene):
    dense = (*LESS, "gaussians.init_opacity=0.6", "gaussians.init_indicator=0.6", CODES)
    module = module_of(tiny_scene, *dense, "trainer.transmittance_min=0.05")
    whole, target = module_of(tiny_scene, *dense), module.views[0]
    fused = module.model.fuse()

    def at(least: float, color: bool) -> Tensor:
        raster = replace(module.model.raster, transmittance_min=least)
        render = module.model.render(target.view.camera, color=color, fused=fused, raster=raster)
        image = render.color if color else render.feature
        assert image is not None
        return image.detach()

    again = module.step.forward(0).seen.render(target.view.camera, color=False)
    given = module.step.render(0, target, fused)
    for render, color in ((given.color, True), (again.feature, False)):
        assert render is not None
        assert torch.equal(render, at(0.05, color))
        lost = float((render.detach() - at(1e-4, color)).abs().max())
        assert lost > 0
        assert not color or lost <= 0.05  # times colours, which are at most 1
    assert module.model.raster == whole.model.raster
    ends = whole.model.render(target.view.camera).color
    assert ends is not None
    assert torch.equal(at(1e-4, color=True), ends)


def test_a_stop_that_is_earlier_in_every_picture_stays(tiny_scene: Scene):
    given = ("raster=fast", "trainer.transmittance_min=0.001", "gaussians.init_opacity=0.6")
    module = module_of(tiny_scene, *LESS, *given)
    camera = module.views[0].view.camera
    render = module.step.render(0, module.views[0], module.model.fuse()).color
    whole = module.model.render(camera).color
    assert render is not None
    assert whole is not None
    assert torch.equal(render, whole)


def test_where_no_shape_is_learned_the_stop_is_that_of_kept_weights(tiny_scene: Scene):
    frozen = "trainer.freeze=[means,quats,log_scales,sh0,shN,opacity_logits,indicator_logits]"
    given = (*LESS, "gaussians.densify.stop=0", "fusion=none", frozen, CODES)
    dense = ("gaussians.init_indicator=0.6", "trainer.transmittance_min=0.1", "blend=none")
    kept = module_of(tiny_scene, *given, *dense)
    rendered = module_of(tiny_scene, *given, *dense, "trainer.skip.frozen_weights=false")
    one, other = (m.step.forward(0).seen.renders[0].feature for m in (kept, rendered))
    assert one is not None
    assert other is not None
    torch.testing.assert_close(one, other, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("transmittance_min", -0.1),
        ("transmittance_min", 0.2),
        ("color_decay", 1.5),
        ("rates_for", 0),
        ("half_size", -0.1),
        ("half_size", 1.1),
        ("steps_scaler", 0.0),
        ("steps_scaler", float("nan")),
    ],
)
def test_what_cannot_be_is_refused_by_name(key: str, value: float):
    with pytest.raises(ValueError, match=f"trainer: {key} must be"):
        TrainerConfig(10, LearningRates(), **{key: value})  # type: ignore[arg-type]


def test_best_takes_large_steps_in_a_short_budget_and_lets_its_positions_rest_as_far():
    given = TrainerConfig(1, LearningRates()).learning_rates
    ends = {
        trainer: composed("method=best", f"trainer={trainer}").trainer.learning_rates
        for trainer in ("default", "fast", "photos", "fast_photos")
    }
    assert {rates.means for rates in ends.values()} == {given.means}
    assert ends["default"].means_final == given.means_final
    for trainer in ("fast", "photos", "fast_photos"):
        assert ends[trainer].means_final == pytest.approx(given.means / 10), trainer
