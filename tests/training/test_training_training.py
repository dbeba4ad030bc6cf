import math
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from slow import with_slow
from tiny_runs import TINY, composed
from torch import Tensor

from vlgs.config import instantiate
from vlgs.gaussians.densify import DensifyReport
from vlgs.objectives.targets import Target, TrainingViews
from vlgs.runs import RunFolder
from vlgs.training.build import Parts, build_module
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.training.pixel_error import pixel_error
from vlgs.types import Scene, View

SCHEDULE = (
    "trainer=smoke",
    "trainer.iterations=24",
    "trainer.checkpoint_every=5",
    "trainer.sh_every=6",
    "gaussians.densify={start: 2, stop: 22, every: 4, reset_every: 12}",
    "gaussians.densify.grad_threshold=1e-6",
)
"""Densifies at 4, 8, ..., resets at 12, raises the SH degree at 6, 12, 18."""


def module_of(scene: Scene, *overrides: str) -> VLGSModule:
    config = composed(*TINY, *SCHEDULE, *overrides)
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, config.seed)


def train(module: VLGSModule, folder: Path) -> VLGSModule:
    fit(module, RunFolder(folder), FitOptions(meta={}, progress=False))
    return module


def state_of(module: VLGSModule) -> dict[str, Tensor]:
    state = dict(module.model.state_dict())
    for group in module.optimizer.param_groups:
        for index, parameter in enumerate(group["params"]):
            for key, value in module.optimizer.state[parameter].items():
                state[f"adam.{group['name']}.{index}.{key}"] = value
    state["grad_sum"], state["count"] = (
        module.densifying.state.grad_sum,
        module.densifying.state.count,
    )
    return state


def assert_same_bits(a: VLGSModule, b: VLGSModule) -> None:
    one, two = state_of(a), state_of(b)
    assert one.keys() == two.keys()
    different = [key for key in one if not torch.equal(one[key], two[key])]
    assert not different


def stop_at(module: VLGSModule, step: int) -> None:
    """Make training ask for a stop after so many steps, as a Ctrl-C does."""
    original = module.training_step

    def training_step(current: int, batch_idx: int) -> None:
        original(current, batch_idx)
        if current + 1 == step:
            module.trainer.should_stop = True

    module.training_step = training_step  # type: ignore[method-assign]


@pytest.fixture(scope="module")
def whole(tiny_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> VLGSModule:
    """Trained without a stop."""
    return train(module_of(tiny_scene), tmp_path_factory.mktemp("whole"))


# 5: between densifications, statistics half gathered; 8: right after one; 13: after the reset; 17: after a degree joined.
@pytest.mark.parametrize("stop", with_slow([5, 8, 13, 17], [8, 17]))
@pytest.mark.usefixtures("unchecked")
def test_resume_is_bit_identical_to_never_having_stopped(
    tiny_scene: Scene, whole: VLGSModule, tmp_path: Path, stop: int
):
    first = module_of(tiny_scene)
    stop_at(first, stop)
    train(first, tmp_path / "parts")
    assert first.next_step == stop
    second = train(module_of(tiny_scene), tmp_path / "parts")
    assert second.next_step == 24
    assert whole.model.count != len(tiny_scene.points), (
        "the schedule must densify for this test to mean anything"
    )
    assert_same_bits(whole, second)


ONCE = "trainer.iterations=13"
"""To the first reset in `SCHEDULE` and a step beyond: densification and degrees have been there too."""

CHOSEN = ("gaussians.densify.long_axis=true", "gaussians.densify.by_error=true")
"""How everyday trainers densify."""


@pytest.mark.parametrize("stop", with_slow([3, 9], [9]))  # 3: small views; 9: whole ones
@pytest.mark.usefixtures("unchecked")
def test_densification_by_error_resumes_to_the_bit(tiny_scene: Scene, tmp_path: Path, stop: int):
    options = (*CHOSEN, "trainer.half_size=0.3", "trainer.iterations=15")
    whole = train(module_of(tiny_scene, *options), tmp_path / "whole")
    first = module_of(tiny_scene, *options)
    stop_at(first, stop)
    train(first, tmp_path / "parts")
    assert_same_bits(whole, train(module_of(tiny_scene, *options), tmp_path / "parts"))
    other = train(module_of(tiny_scene, *options[2:]), tmp_path / "other")
    assert not torch.equal(whole.model.splats["means"], other.model.splats["means"])


def test_errors_are_summed_with_the_weights_that_blend_them(tiny_scene: Scene):
    module = module_of(tiny_scene, "gaussians.init_opacity=0.6")
    model, cameras = module.model, module.views.scene.train
    with torch.no_grad():
        fused, want = model.fuse(), torch.zeros(model.count)
        for index in range(len(cameras)):  # fewer than are drawn
            error = module.step.color_error(index, 0, fused)
            color = model.render(cameras[index].camera).color
            assert color is not None
            own = (color - module.views[index].image).abs()
            torch.testing.assert_close(error, own.mean(-1))
            one, scores = torch.eye(model.count)[:4], fused.gaussians.opacities
            for row in range(4):  # the image of a Gaussian that alone is white is its weight
                image = model.render_values(cameras[index].camera, one[row][:, None], scores)
                want[row] += (image[..., 0] * error).sum()
    torch.testing.assert_close(pixel_error(module, 0)[:4], want[:4], rtol=1e-4, atol=1e-5)
    assert want[:4].max() > 0


def test_errors_are_summed_in_the_shapes_of_colour(tiny_scene: Scene):
    module = module_of(tiny_scene, "sharing=pos")
    before = pixel_error(module, 0)
    with torch.no_grad():
        module.model.splats["language_log_scales"] += 1
    assert torch.equal(pixel_error(module, 0), before)


@pytest.mark.usefixtures("unchecked")
def test_the_same_seed_gives_the_same_bits_for_any_number_of_threads(
    tiny_scene: Scene, tmp_path: Path
):
    threads = torch.get_num_threads()
    try:
        modules = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            modules.append(train(module_of(tiny_scene, *CHOSEN), tmp_path / str(count)))
    finally:
        torch.set_num_threads(threads)
    assert_same_bits(modules[0], modules[1])
    assert_same_bits(modules[0], modules[2])


@pytest.mark.usefixtures("unchecked")
def test_training_lowers_the_loss(tiny_scene: Scene, tmp_path: Path):
    module = module_of(tiny_scene, "trainer.iterations=40")
    losses = []
    original = module.training_step

    def recorded(step: int, batch_idx: int) -> None:
        original(step, batch_idx)
        losses.append(module.report.loss)

    module.training_step = recorded  # type: ignore[method-assign]
    train(module, tmp_path)
    assert sum(losses[-10:]) < 0.7 * sum(losses[:10])


def test_a_non_finite_image_stops_with_a_name_and_keeps_the_checkpoint(
    tiny_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    module = module_of(tiny_scene, "trainer.checkpoint_every=4")
    original = TrainingViews.__getitem__

    def poisoned(views: TrainingViews, index: int) -> Target:
        target = original(views, index)
        if module.next_step >= 9:
            target.image[3, 2, 1] = float("nan")
        return target

    monkeypatch.setattr(TrainingViews, "__getitem__", poisoned)
    with pytest.raises(
        FloatingPointError, match=r"loss must be finite, got nan in step 9 with views \w+ and \w+"
    ):
        train(module, tmp_path)
    checkpoint = load_checkpoint(tmp_path / "checkpoint")
    assert checkpoint is not None
    assert checkpoint.step == 8
    assert all(value.isfinite().all() for value in checkpoint.tensors.values())


@pytest.mark.parametrize(
    "name",
    ["means", "quats", "log_scales", "sh0", "opacity_logits", "indicator_logits", "features"],
)
def test_a_non_finite_gradient_names_its_row(tiny_scene: Scene, tmp_path: Path, name: str):
    module = module_of(tiny_scene)

    def poison(gradient: Tensor) -> Tensor:
        gradient = gradient.clone()
        gradient[7] = float("nan")
        return gradient

    module.model.splats[name].register_hook(poison)
    with pytest.raises(
        FloatingPointError,
        match=rf"gradient of splats\.{name} must be finite, .* in row 7 in step 0",
    ):
        train(module, tmp_path)


def test_densification_is_part_of_the_training_time(
    tiny_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    clock = {"now": 0.0}

    def slow_densify(*args: object) -> DensifyReport:
        clock["now"] += 100.0
        return DensifyReport(0, 0, 0, 0)

    now = SimpleNamespace(perf_counter=lambda: clock["now"])
    monkeypatch.setattr("vlgs.training.callbacks.time", now)
    monkeypatch.setattr("vlgs.training.callbacks.densify", slow_densify)
    module = train(module_of(tiny_scene, "trainer.iterations=9"), tmp_path)
    assert module.train_seconds == 200  # after 4 and 8 iterations


@pytest.mark.parametrize(
    ("iterations", "densified", "reset"), [(12, [4, 8], 0), (13, [4, 8, 12], 1)]
)
def test_a_budget_that_ends_on_a_densification_leaves_it_out(
    tiny_scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    iterations: int,
    densified: list[int],
    reset: int,
):
    after: list[int] = []
    resets: list[object] = []

    def recorded(*args: object) -> DensifyReport:
        after.append(cast(int, args[6]))
        return DensifyReport(0, 0, 0, 0)

    monkeypatch.setattr("vlgs.training.callbacks.densify", recorded)
    monkeypatch.setattr("vlgs.training.callbacks.reset_opacity", lambda *args: resets.append(args))
    train(module_of(tiny_scene, f"trainer.iterations={iterations}"), tmp_path)
    assert (after, len(resets)) == (densified, reset)


def test_a_large_gradient_is_no_fault(tiny_scene: Scene, tmp_path: Path):
    """Its square is infinite in float32, it is not."""
    module = module_of(tiny_scene, "trainer.iterations=1")
    module.model.splats["features"].register_hook(lambda gradient: gradient.clamp_min(1e30))
    assert train(module, tmp_path).next_step == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [("log_scales", -math.inf), ("opacity_logits", math.inf), ("indicator_logits", -math.inf)],
)
def test_an_infinite_parameter_of_a_finite_picture_names_its_row(
    tiny_scene: Scene, tmp_path: Path, name: str, value: float
):
    module = module_of(tiny_scene)
    with torch.no_grad():
        module.model.splats[name][7] = value
    with pytest.raises(
        FloatingPointError, match=rf"train: splats\.{name} must be finite, .* in row 7 in step 0"
    ):
        train(module, tmp_path)


def test_a_view_that_sees_nothing_trains_on(tiny_scene: Scene, tmp_path: Path):
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))  # looks the other way
    blind = tuple(
        replace(view, camera=replace(view.camera, viewmat=away @ view.camera.viewmat))
        if i == 0
        else view
        for i, view in enumerate(tiny_scene.train)
    )
    module = train(module_of(replace(tiny_scene, train=blind), ONCE), tmp_path)
    assert module.next_step == 13
    assert module.model.splats["means"].isfinite().all()


def test_a_scene_without_language_trains_colour_only(tiny_scene: Scene, tmp_path: Path):
    silent = replace(
        tiny_scene,
        mask_vectors=torch.zeros(0, 512),
        mask_areas=torch.zeros(0),
        train=tuple(replace(view, read_masks=None) for view in tiny_scene.train),
    )
    module = train(module_of(silent, ONCE), tmp_path)
    assert module.skips.done("blended render") == 0
    assert torch.equal(
        module.model.splats["features"], torch.zeros_like(module.model.splats["features"])
    )


def test_no_training_views_is_refused(tiny_scene: Scene):
    with pytest.raises(ValueError, match=r"training views of .* must be at least 1, got 0"):
        module_of(replace(tiny_scene, train=()))


def test_one_view_is_enough(tiny_scene: Scene, tmp_path: Path):
    alone: tuple[View, ...] = tiny_scene.train[:1]
    assert train(module_of(replace(tiny_scene, train=alone), ONCE), tmp_path).next_step == 13


@pytest.mark.parametrize("blend", ["blend=none", "loss.blended_view.weight=0.0"])
@pytest.mark.usefixtures("unchecked")
def test_a_blended_view_without_weight_is_not_rendered(
    tiny_scene: Scene, tmp_path: Path, blend: str
):
    module = train(module_of(tiny_scene, blend, ONCE), tmp_path)
    assert module.skips.done("blended render") == 0


def test_similarity_is_computed_once_per_pair_and_symmetric(tiny_scene: Scene):
    module = module_of(tiny_scene)
    assert module.views.similarity(1, 4) == module.views.similarity(4, 1)
    assert len(module.views.similarities) == 1
    assert 0 <= module.views.similarity(1, 4) <= 1


AXES = (
    ["fusion=none", "indicator=opacity", "blend=none"],
    ["fusion=mlp", "indicator=fixed", "blend=fixed"],
    ["fusion=cross", "blend=gaussian", "blend.convention=paper"],
    ["blend=uniform", "blend.rotation=false", "loss.photometric.error=l1_dssim"],
    ["gaussians.densify_on=rgb", "gaussians.prune_on=opacity", "gaussians.sh_degree=0"],
    ["gaussians.color=rgb", "gaussians.prune_on=indicator", "blend.mask=or"],
    ["gaussians.color=evaluated", "blend.pairs=neighbours", "trainer.means_steps=30000"],
    ["gaussians.init_features=lifted", "blend.kept=nearer", "blend.rotation=false"],
    ["sharing=pos", "gaussians.densify.reset_indicator=true", "indicator=opacity"],
    ["sharing=pos", "indicator=opacity", *CHOSEN],
    ["gaussians.color=evaluated", "trainer.exposure=true", *CHOSEN],
    ["gaussians.densify.share_weights=true", "gaussians.background=0", CHOSEN[1]],
)
LIKE_OTHERS = (*AXES[1:4], AXES[5], AXES[7], AXES[9])
"""All of whose values some other test trains, or stand beside another one's of the same parts."""


@pytest.mark.parametrize("axes", with_slow(AXES, LIKE_OTHERS), ids=" ".join)
def test_points_on_the_axes_train(tiny_scene: Scene, tmp_path: Path, axes: list[str]):
    module = train(module_of(tiny_scene, *axes, ONCE), tmp_path)
    assert all(p.isfinite().all() for p in module.model.parameters())


def test_only_trained_modalities_move(tiny_scene: Scene, tmp_path: Path):
    """indicator=opacity gives the indicator no gradient: Adam must leave it where it started."""
    module = module_of(tiny_scene, "indicator=opacity", "gaussians.densify.start=100", ONCE)
    before = module.model.splats["indicator_logits"].detach().clone()
    train(module, tmp_path)
    assert torch.equal(module.model.splats["indicator_logits"].detach(), before)
