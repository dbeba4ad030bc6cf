"""Options for what the paper leaves open (conf/README.md): each does what its name says."""

from dataclasses import fields, replace

import jaxtyping
import pytest
import torch
from tiny_runs import TINY, composed

from vlgs.config import instantiate
from vlgs.fields.saved import plan_of_model
from vlgs.gaussians.in_air import near_plane
from vlgs.geometry import camera_center
from vlgs.training.build import Parts, build_module
from vlgs.training.callbacks import ClearAir, Narrow
from vlgs.training.lightning import VLGSModule
from vlgs.training.settings import LearningRates, TrainerConfig
from vlgs.types import Scene
from vlgs.view_blend import BetaBlend, blend_camera


def module_of(scene: Scene, *overrides: str) -> VLGSModule:
    config = composed(*TINY, "trainer=smoke", *overrides)
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, config.seed)


def with_harmonics(module: VLGSModule, size: float) -> VLGSModule:
    splats = module.model.splats
    rng = torch.Generator().manual_seed(1)
    with torch.no_grad():
        splats["shN"].copy_(size * torch.randn(splats["shN"].shape, generator=rng))
        splats["features"].copy_(torch.rand(splats["features"].shape, generator=rng))
    module.model.sh_degree = 3
    return module


def test_rgb_has_no_harmonics(tiny_scene: Scene):
    module = module_of(tiny_scene, "gaussians.color=rgb")
    assert module.model.splats["shN"].shape[1:] == (0, 3)
    module.set_schedule(10_000)
    assert module.model.sh_degree == 0


@pytest.mark.parametrize("color", ["rgb_dc", "evaluated"])
def test_only_evaluated_colour_makes_language_depend_on_the_harmonics(
    tiny_scene: Scene, color: str
):
    camera = tiny_scene.test[0].camera
    overrides = f"gaussians.color={color}", "fusion=mlp", "fusion.residual=false"
    flat, bright = (with_harmonics(module_of(tiny_scene, *overrides), s) for s in (0.0, 0.5))
    one, two = (module.model.render(camera) for module in (flat, bright))
    assert one.color is not None
    assert two.color is not None
    assert one.feature is not None
    assert two.feature is not None
    assert not torch.equal(one.color, two.color)
    assert torch.equal(one.feature, two.feature) == (color == "rgb_dc")


def test_without_harmonics_all_three_are_one(tiny_scene: Scene):
    camera = tiny_scene.test[0].camera
    images = []
    for color in ("rgb_dc", "rgb", "evaluated"):
        module = module_of(tiny_scene, f"gaussians.color={color}", "fusion=mlp")
        images.append(module.model.render(camera))
    for image in images[1:]:
        torch.testing.assert_close(image.color, images[0].color, rtol=0, atol=0)
        torch.testing.assert_close(image.feature, images[0].feature, rtol=0, atol=0)


def test_lifted_codes_are_the_weighted_means_of_what_is_seen(tiny_scene: Scene):
    few = replace(tiny_scene, train=tiny_scene.train[:2])
    module = module_of(few, "gaussians.init_features=lifted")
    model = module.model
    n = model.count
    weight = model.fuse().language_weight.detach()
    above = torch.zeros(n, 3)
    below = torch.zeros(n)
    for index, view in enumerate(few.train):
        target = module.views[index]
        blended = model.render_values(view.camera, torch.eye(n), weight)[target.valid].detach()
        above += blended.T @ target.codes[target.valid]
        below += blended.sum(dim=0)
    seen = below > 1e-4
    assert 0 < seen.sum() <= n
    want = above[seen] / below[seen, None]
    torch.testing.assert_close(model.splats["features"][seen].detach(), want, rtol=1e-3, atol=1e-4)
    assert not model.splats["features"][below == 0].any()


def test_positions_slow_down_over_the_steps_they_are_given():
    rates = LearningRates()
    whole = TrainerConfig(1000, rates)
    longer = TrainerConfig(1000, rates, means_steps=2000)
    assert whole.means_rate(1000) == pytest.approx(rates.means_final)
    assert longer.means_rate(1000) == pytest.approx((rates.means * rates.means_final) ** 0.5)
    with pytest.raises(ValueError, match="means_steps must be at least 1, got 0"):
        TrainerConfig(1000, rates, means_steps=0)


def test_codes_and_indicators_slow_down_along_half_a_cosine(tiny_scene: Scene):
    settings = TrainerConfig(1000, LearningRates(), language_decay=0.1)
    shares = [settings.decay("features", step) for step in (0, 500, 1000, 2000)]
    assert shares == pytest.approx([1, 0.55, 0.1, 0.1])
    assert TrainerConfig(1000, LearningRates()).decay("features", 700) == 1
    module = module_of(tiny_scene, "trainer.iterations=100", "trainer.language_decay=0.1")
    module.set_schedule(50)
    rates = {group["name"]: group["lr"] for group in module.optimizer.param_groups}
    assert rates["features"] == pytest.approx(0.55 * 5e-3)
    assert rates["indicator_logits"] == pytest.approx(0.55 * 5e-2)
    assert rates["opacity_logits"] == 5e-2
    with pytest.raises(ValueError, match="language_decay must be"):
        TrainerConfig(1000, LearningRates(), language_decay=1.5)


def test_nothing_is_drawn_nearer_than_a_share_of_what_cameras_see(tiny_scene: Scene):
    near = near_plane(tiny_scene, 0.5)
    assert near > 0.1
    module = module_of(tiny_scene, "gaussians.near_share=0.5")
    assert module.model.raster.near == near
    assert (
        plan_of_model(module.model, True, True)["raster"]["near"] == near
    )  # what a folder is read by
    assert module_of(tiny_scene, "gaussians.near_share=0.0").model.raster.near == 0.01
    assert module_of(tiny_scene, "gaussians.near_share=1e-4").model.raster.near == 0.01


def test_where_nobody_looked_a_background_that_starts_opaque_is_not_dark(tiny_scene: Scene):
    """No photograph shows it, so that training cannot make it so."""

    def covered(*overrides: str) -> float:
        model = module_of(tiny_scene, "gaussians.background=500", *overrides).model
        camera = tiny_scene.train[0].camera
        back = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ camera.viewmat
        away, gaussians = replace(camera, viewmat=back), model.gaussians()
        ones = torch.ones_like(gaussians.opacities)[:, None]
        return model.render_values(away, ones, gaussians.opacities).mean().item()

    assert covered("gaussians.background_opacity=null") < 0.8
    assert covered("gaussians.background_opacity=0.9") > 0.95


def test_scales_stay_away_from_cameras_while_they_are_trained(tiny_scene: Scene):
    module = module_of(tiny_scene, "gaussians.max_angle=0.3", "gaussians.densify.every=5")
    model, centers = module.model, module.densifying.centers
    with torch.no_grad():
        model.splats["log_scales"][:50] = 3.0
    most = 0.3 * torch.cdist(model.splats["means"].detach(), centers).amin(dim=1)

    def too_large() -> int:
        return int((model.splats["log_scales"].exp().amax(dim=1) > 1.001 * most).sum())

    assert too_large() == 50
    for done, left in ((6, 50), (10, 0)):
        module.next_step = done
        Narrow().after_step(module)
        assert too_large() == left
    with torch.no_grad():
        model.splats["log_scales"][:50] = 3.0
    module.next_step = module.settings.iterations
    model.splats["log_scales"].requires_grad_(False)
    Narrow().after_step(module)
    assert too_large() == 50, "what is frozen stays"
    model.splats["log_scales"].requires_grad_(True)
    Narrow().after_step(module)
    assert too_large() == 0


def test_air_is_cleared_in_the_end_of_what_colour_cannot_see(tiny_scene: Scene):
    module = module_of(tiny_scene, "gaussians.clear_air=true")
    camera, splats = tiny_scene.train[0].camera, module.model.splats
    axis = camera.viewmat[:3, :3].T @ torch.tensor([0.0, 0.0, 0.05])
    with torch.no_grad():
        splats["means"][:2] = camera_center(camera.viewmat) + axis
        splats["opacity_logits"][:3] = torch.tensor([-6.0, 2.0, -6.0])  # the third is where it was
        splats["indicator_logits"][:2] = 4.0
    before = module.model.render(camera)
    n, module.next_step = module.model.count, module.settings.iterations - 1
    ClearAir().after_step(module)
    assert module.model.count == n
    module.next_step += 1
    ClearAir().after_step(module)
    assert module.model.count == n - 1
    after = module.model.render(camera)
    assert before.color is not None
    assert after.color is not None
    assert before.alpha_language is not None
    assert after.alpha_language is not None
    assert torch.equal(after.color, before.color)
    assert not torch.equal(after.alpha_language, before.alpha_language)


@pytest.mark.parametrize("k", [0.2, 0.8])
def test_what_is_not_blended_stays_that_of_the_nearer_view(tiny_scene: Scene, k: float):
    one, two = tiny_scene.train[0].camera, tiny_scene.train[3].camera
    nearer = one if k > 0.5 else two
    moved = blend_camera(one, two, k, BetaBlend(rotation=False, kept="nearer"))
    torch.testing.assert_close(moved.viewmat[:3, :3], nearer.viewmat[:3, :3])
    centers = [camera_center(camera.viewmat) for camera in (one, two)]
    want = k * centers[0] + (1 - k) * centers[1]
    torch.testing.assert_close(camera_center(moved.viewmat), want, atol=1e-5, rtol=0)
    turned = blend_camera(one, two, k, BetaBlend(translation=False, kept="nearer"))
    torch.testing.assert_close(
        camera_center(turned.viewmat), camera_center(nearer.viewmat), atol=1e-5, rtol=0
    )
    first = blend_camera(one, two, k, BetaBlend(rotation=False))
    torch.testing.assert_close(first.viewmat[:3, :3], one.viewmat[:3, :3])


def test_pairs_of_neighbours(tiny_scene: Scene):
    module = module_of(tiny_scene, "blend.pairs=neighbours", "blend.neighbours=1")
    near = module.views.sampler.near
    assert near is not None
    for step in range(12):
        first, second = module.views.sampler.pair(step)
        assert near[first] == (second,)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("gaussians.color=hsv", "color must be one of rgb_dc, rgb, evaluated, got 'hsv'"),
        (
            "gaussians.init_features=zeros",
            "init_features must be one of zero, lifted, normal, random, got 'zeros'",
        ),
        ("blend.kept=second", "kept must be one of first, nearer, got 'second'"),
        ("blend.pairs=near", "pairs must be one of uniform, neighbours, got 'near'"),
        ("blend.neighbours=0", "neighbours must be at least 1, got 0"),
    ],
)
def test_a_slip_is_named(
    tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch, override: str, message: str
):
    monkeypatch.setattr(
        jaxtyping.config, "jaxtyping_disable", True
    )  # the annotation would be first
    with pytest.raises(ValueError, match=message):
        module_of(tiny_scene, override)
