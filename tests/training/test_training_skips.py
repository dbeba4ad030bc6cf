"""What training leaves out: nothing is lost where `vlgs.skips` says exact, no more than its bound elsewhere."""

import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_runs import TINY, composed
from torch import Tensor

import vlgs.training.workshop
from vlgs.config import instantiate
from vlgs.experiment import construct
from vlgs.fields.splat import FusedGaussians
from vlgs.gaussians import write_ply
from vlgs.geometry import camera_center
from vlgs.objectives import Language
from vlgs.objectives.between import plan_blend
from vlgs.runs import RunFolder
from vlgs.skip_count import WORK, SkipCount
from vlgs.skips import SKIPS
from vlgs.training.build import Parts, build_module
from vlgs.training.cached_renders import CachedRenders
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.training.settings import OTHERS, SkipConfig
from vlgs.training.state import capture, restore
from vlgs.training.workshop import Workshop
from vlgs.types import Camera, Scene
from vlgs.view_blend import BetaBlend, blend_camera

GEOMETRY = "means,quats,log_scales,opacity_logits"
COLOR = "sh0,shN"


def module_of(scene: Scene, *overrides: str) -> VLGSModule:
    config = composed(
        *TINY, "trainer=smoke", "trainer.iterations=12", "gaussians.densify.stop=0", *overrides
    )
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, config.seed)


def train(module: VLGSModule, folder: Path) -> VLGSModule:
    fit(module, RunFolder(folder), FitOptions(meta={}, progress=False))
    return module


def first_step(module: VLGSModule) -> tuple[float, dict[str, Tensor]]:
    """Loss and gradients of one iteration from where all modules of a test start."""
    with torch.no_grad():  # codes that are not zero
        rng = torch.Generator().manual_seed(5)
        module.model.splats["features"].copy_(
            torch.randn(module.model.splats["features"].shape, generator=rng)
        )
    module.set_schedule(0)
    original = module.optimizer.step
    module.optimizer.step = lambda *_: None  # type: ignore[method-assign]
    module.training_step(0, 0)
    module.optimizer.step = original  # type: ignore[method-assign]
    grads = {n: p.grad.clone() for n, p in module.model.named_parameters() if p.grad is not None}
    return module.report.loss, grads


def assert_same_step(a: VLGSModule, b: VLGSModule, tolerance: float) -> None:
    (loss, grads), (other_loss, other) = first_step(a), first_step(b)
    assert loss == pytest.approx(other_loss, rel=tolerance, abs=tolerance)
    assert grads.keys() == other.keys()
    for name, gradient in grads.items():
        difference = (gradient - other[name]).norm() / other[name].norm().clamp_min(1e-12)
        assert difference <= tolerance, name


def dissimilar(scene: Scene) -> Scene:
    """Two views whose photographs are each other's negatives: SSIM below 0, clamped to 0."""
    first, second = scene.train[:2]
    image = first.read_image()
    return replace(scene, train=(first, replace(second, read_image=lambda: 255 - image)))


def test_a_blended_view_of_no_weight_adds_nothing(tiny_scene: Scene):
    scene = dissimilar(tiny_scene)
    skipping, rendering = module_of(scene), module_of(scene, "trainer.skip.blend_weight=-1.0")
    assert_same_step(skipping, rendering, 0.0)
    assert skipping.skips.skipped == {"blend_zero": 1}
    assert rendering.skips.done("blended render") == 1


def test_a_view_is_not_blended_with_itself(tiny_scene: Scene):
    module = module_of(replace(tiny_scene, train=tiny_scene.train[:1]))
    first_step(module)
    assert module.skips.done("blended render") == 0
    assert module.skips.skipped == {}  # no skip, but no pair


def test_skipping_a_light_blended_view_changes_the_loss_by_its_bound(tiny_scene: Scene):
    limit = 1.3  # above lambda: every view is light
    skipping = module_of(tiny_scene, f"trainer.skip.blend_weight={limit}")
    rendering = module_of(tiny_scene)
    losses = []
    language = rendering.step.setup.objectives["language"]
    assert isinstance(language, Language)
    original = language.of

    def recorded(*arguments: Tensor) -> Tensor:
        losses.append(original(*arguments))
        return losses[-1]

    language.of = recorded  # type: ignore[method-assign]
    difference = first_step(rendering)[0] - first_step(skipping)[0]
    mse = float(losses[-1].detach())  # the blended view's comes last
    assert 0 < difference <= limit * mse * (1 + 1e-5)
    assert skipping.skips.skipped == {"blend_small": 1}


def pose_error(a: Camera, b: Camera) -> tuple[float, float]:
    """Distance of the centres and angle between the rotations."""
    rotations, centers = zip(
        *((c.viewmat[:3, :3].double(), camera_center(c.viewmat.double())) for c in (a, b)),
        strict=True,
    )
    chord = (rotations[0] - rotations[1]).norm() / math.sqrt(
        8
    )  # sin(angle / 2), also where it is small
    return float((centers[0] - centers[1]).norm()), 2 * math.asin(min(1.0, float(chord)))


def test_a_reused_view_is_near(tiny_scene: Scene):
    delta, blend, rng = 0.01, BetaBlend(), np.random.default_rng(0)
    cameras = tiny_scene.train[0].camera, tiny_scene.train[3].camera
    distance, angle = pose_error(*cameras)
    reused, worst = 0, 0.0
    for _ in range(400):
        k = blend.draw(rng)
        true = blend_camera(*cameras, k, blend)
        plan = plan_blend(cameras, k, true, 1.0, 1.0, blend, delta)
        if plan.reuse is None:
            assert delta <= k <= 1 - delta
            continue
        reused += 1
        off, turned = pose_error(plan.camera, true)
        assert off <= delta * distance + 1e-6
        assert turned <= delta * angle + 1e-6
        worst = max(worst, turned / (delta * angle))
    assert 0.35 < reused / 400 < 0.5  # 42 % of Beta(0.2, 0.2)
    assert worst > 0.5


@pytest.mark.parametrize(
    ("k", "switches", "reuse"),
    [
        (1.0, {}, 0),
        (0.0, {}, 1),
        (0.0, {"rotation": False}, None),
        (0.0, {"translation": False}, None),
        (1.0, {"rotation": False}, 0),
        (1.0, {"convention": "paper"}, None),
        (-3.0, {}, None),
        (0.5, {}, None),
    ],
)
def test_only_a_view_that_is_there_is_reused(
    tiny_scene: Scene, k: float, switches: dict[str, object], reuse: int | None
):
    cameras = tiny_scene.train[0].camera, tiny_scene.train[3].camera
    blend = BetaBlend(**switches)  # pyright: ignore[reportArgumentType]
    between = blend_camera(*cameras, k, blend)
    assert plan_blend(cameras, k, between, 1.0, 1.0, blend, 0.01).reuse == reuse


@pytest.mark.parametrize("value", ["0.0", "1.0"])
def test_at_the_ends_reuse_is_exact_to_float_order(tiny_scene: Scene, value: str):
    at_end = ("blend=fixed", f"blend.value={value}")
    on = module_of(tiny_scene, *at_end, "trainer.skip.blend_reuse=0.01")
    # Two gradients of one picture are added before the backward pass instead of after two: 7e-6 in quats, which cancel.
    assert_same_step(on, module_of(tiny_scene, *at_end), 2e-5)
    assert on.skips.skipped == {"blend_reuse": 1}


FROZEN = {
    "language alone": (f"trainer.freeze=[{GEOMETRY},{COLOR},indicator_logits]", "fusion=none"),
    "through the fusion": (f"trainer.freeze=[{GEOMETRY},{COLOR},indicator_logits]",),
    "opacity": (f"trainer.freeze=[{GEOMETRY},{COLOR}]", "indicator=opacity", "fusion=none"),
    "colour moves": (f"trainer.freeze=[{GEOMETRY},indicator_logits]",),
}


@pytest.mark.parametrize("case", FROZEN)
def test_kept_weights_train_the_same(tiny_scene: Scene, case: str):
    on = module_of(tiny_scene, *FROZEN[case])
    off = module_of(tiny_scene, *FROZEN[case], "trainer.skip.frozen_weights=false")
    assert_same_step(on, off, 1e-6)
    assert on.skips.done("weights") > 0
    assert off.skips.done("weights") == 0


def test_weights_are_made_once_per_view(tiny_scene: Scene, tmp_path: Path):
    module = module_of(tiny_scene, *FROZEN["language alone"])
    before = {name: value.detach().clone() for name, value in module.model.splats.items()}
    train(module, tmp_path)
    moved = {n for n, v in module.model.splats.items() if not torch.equal(v.detach(), before[n])}
    assert moved == {"features"}
    assert module.model.sh_degree == 3
    views = len(tiny_scene.train)
    assert module.skips.done("weights") == 2 * views  # one for colour, one for language
    assert module.skips.skipped["frozen_weights"] == 2 * 2 * 12 - 2 * views
    assert module.skips.skipped["frozen_color"] == 2 * 12 - views


def test_views_beyond_the_budget_are_rendered_in_full(tiny_scene: Scene, tmp_path: Path):
    module = module_of(tiny_scene, *FROZEN["language alone"], "trainer.skip.frozen_budget=1000")
    assert train(module, tmp_path).next_step == 12
    assert "frozen_weights" not in module.skips.skipped


def test_which_views_are_kept_does_not_depend_on_their_order(
    tiny_scene: Scene, caplog: pytest.LogCaptureFixture
):
    """Or a resumed run, whose first views are others, would have other bits."""
    module = module_of(tiny_scene, *FROZEN["opacity"])
    cameras, fused = [view.camera for view in tiny_scene.train], module.model.fuse()
    whole = CachedRenders(module.model, cameras, 1 << 30, SkipCount())
    assert all(_rendered(whole, index, fused) for index in range(len(cameras)))
    sizes = [
        view.nbytes
        for view in (whole.views.get((i, "opacity")) for i in range(len(cameras)))
        if view
    ]
    for kept in (0, 1, 4):
        for order in (range(len(cameras)), reversed(range(len(cameras)))):
            caplog.clear()
            with caplog.at_level("INFO"):
                renders = CachedRenders(
                    module.model, cameras, sum(sizes[: kept + 1]) - 1, SkipCount()
                )
                found = {index for index in order if _rendered(renders, index, fused)}
            assert found == set(range(kept))
            assert renders.views.used <= renders.views.budget
            assert caplog.messages[0].startswith(
                f"frozen weights: of {kept} of {len(cameras)} views"
            )


def _rendered(renders: CachedRenders, index: int, fused: FusedGaussians) -> bool:
    return renders.render(index, renders.cameras[index], True, True, fused) is not None


def test_kept_weights_go_when_training_ends(
    tiny_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    modules: list[VLGSModule] = []

    def fitting(module: VLGSModule, *rest: Any) -> str | None:
        modules.append(module)
        return fit(module, *rest)

    monkeypatch.setattr(vlgs.training.workshop, "fit", fitting)
    chosen = (*TINY, "trainer=smoke", "trainer.iterations=2", "gaussians.densify.stop=0")
    parts = construct(composed(*chosen, *FROZEN["opacity"])).make_parts
    options = FitOptions(meta={}, progress=False)
    Workshop(RunFolder(tmp_path), parts, lambda: options, 0).train("", tiny_scene)
    assert modules[0].skips.done("weights") > 0
    assert modules[0].step.frozen is None


def test_the_budget_is_that_of_a_process_and_no_other_id():
    assert SkipConfig().kept_bytes == SkipConfig().frozen_budget - OTHERS == 3 << 28
    assert SkipConfig(frozen_budget=OTHERS // 2).kept_bytes == 0


def test_a_learned_indicator_is_rendered_in_full(tiny_scene: Scene, tmp_path: Path):
    module = train(module_of(tiny_scene, f"trainer.freeze=[{GEOMETRY},{COLOR}]"), tmp_path)
    assert module.skips.done("weights") == 0


def test_what_cannot_be_frozen_is_refused(tiny_scene: Scene):
    with pytest.raises(ValueError, match=r"trainer.freeze must name some of .*, got \['scales'\]"):
        module_of(tiny_scene, "trainer.freeze=[scales]")
    with pytest.raises(ValueError, match=r"densify.stop must be 0 .* got 50"):
        module_of(tiny_scene, "trainer.freeze=[means]", "gaussians.densify.stop=50")
    everything = f"trainer.freeze=[{GEOMETRY},{COLOR},indicator_logits,features]"
    with pytest.raises(ValueError, match="must leave something to train"):
        module_of(tiny_scene, everything, "fusion=none")


def test_a_model_of_another_run_is_where_language_starts(tiny_scene: Scene, tmp_path: Path):
    geometry = train(module_of(tiny_scene), tmp_path / "geometry").model.splats
    path = tmp_path / "point_cloud.ply"
    write_ply(path, geometry)
    module = module_of(tiny_scene, *FROZEN["language alone"], f"gaussians.init={path}")
    train(module, tmp_path / "language")
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN"):
        assert torch.equal(module.model.splats[name], geometry[name]), name
    assert not torch.equal(module.model.splats["features"], geometry["features"])
    with pytest.raises(FileNotFoundError):
        module_of(tiny_scene, "gaussians.init=nowhere.ply")


def test_a_resume_goes_on_counting(tiny_scene: Scene, tmp_path: Path):
    module = train(module_of(tiny_scene, "trainer.skip.blend_reuse=0.2"), tmp_path)
    other = module_of(tiny_scene)
    restore(other, capture(module, {}))
    assert other.skips.report() == module.skips.report()
    assert "blend_reuse" in other.skips.report()


def test_the_report_multiplies_mean_cost_by_count():
    counts = SkipCount()
    counts.add("blended render", 4, 2.0)
    counts.skip("blend_zero", 3)
    counts.skip("blend_reuse")
    counts.skip("frozen_weights")
    assert counts.report() == {
        "blend_reuse": {"skipped": 1, "share": 1 / 8, "seconds_saved": 0.5},
        "blend_zero": {"skipped": 3, "share": 3 / 8, "seconds_saved": 1.5},
        "frozen_weights": {"skipped": 1, "share": 1.0, "seconds_saved": None},
    }
    assert set(WORK) <= {skip.name for skip in SKIPS}
