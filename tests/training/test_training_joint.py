"""Several mask levels in one model (``levels=joint``)."""

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from slow import with_slow
from tiny_runs import TINY, composed

from vlgs.config import instantiate
from vlgs.fields import HasGaussians
from vlgs.fields.trained import SplatField
from vlgs.gaussians import densify, read_ply, write_ply
from vlgs.gaussians.densify import DensifyState
from vlgs.gaussians.logistic import logit
from vlgs.gaussians.parameters import at_levels
from vlgs.heads import Head
from vlgs.heads.identity import Identity
from vlgs.runs import RunFolder
from vlgs.training.build import Parts, bind, build_module
from vlgs.training.fit import FitOptions, fit
from vlgs.training.joint import join_levels
from vlgs.training.lightning import VLGSModule
from vlgs.training.most_shown import most_shown
from vlgs.types import Scene

DENSIFY = (
    "gaussians.densify={start: 2, stop: 22, every: 4, reset_every: 12}",
    "gaussians.densify.grad_threshold=1e-6",
)


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    from vlgs.data.synthetic import load_scene

    def at(level: int) -> Scene:
        return load_scene(width=48, height=36, train_views=6, test_views=2, points=400, level=level)

    return [at(level) for level in (1, 2, 3)]


def module_of(scene: Scene, *overrides: str, head: Head | None = None) -> VLGSModule:
    levels = () if scene.mask_levels == 1 else ("levels=joint",)
    config = composed(*TINY, *levels, "trainer=smoke", "trainer.iterations=24", *overrides)
    torch.manual_seed(0)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    if head is not None:
        parts = replace(parts, head=head)
    return build_module(scene, parts, seed=0)


def train(module: VLGSModule, folder: Path) -> VLGSModule:
    fit(module, RunFolder(folder), FitOptions(meta={}, progress=False))
    return module


def with_masks_at(scenes: list[Scene], level: int) -> list[Scene]:
    """Only one level has masks, though all have vectors."""
    return [
        scene
        if place == level
        else replace(scene, train=tuple(replace(view, read_masks=None) for view in scene.train))
        for place, scene in enumerate(scenes)
    ]


@torch.no_grad()
def stirred(module: VLGSModule) -> VLGSModule:
    """Away from the start, where codes are zero; the same draws for whatever is there."""
    draws = torch.Generator().manual_seed(3)
    codes = torch.randn(module.model.count, module.model.head.dim, generator=draws)
    module.model.splats["features"].copy_(codes.repeat(1, module.model.levels))
    weights = torch.randn(module.model.count, generator=draws)
    log_scales = module.model.splats["log_scales"]  # rotations of a sphere have no gradient
    log_scales.add_(0.3 * torch.randn(log_scales.shape, generator=draws))
    indicators = module.model.splats["indicator_logits"]
    indicators.copy_(weights if indicators.dim() == 1 else weights[:, None])
    return module


def test_a_joined_view_holds_the_masks_of_each_level_and_their_own_vectors(scenes: list[Scene]):
    joint = join_levels(scenes)
    assert joint.mask_levels == 3
    assert (
        len(joint.mask_vectors) == len(joint.mask_areas) == sum(len(s.mask_vectors) for s in scenes)
    )
    for index, view in enumerate(joint.train):
        assert view.read_masks is not None
        rows = view.read_masks()
        assert rows.shape == (36, 48, 3)
        assert rows.dtype == torch.int32
        for level, scene in enumerate(scenes):
            read = scene.train[index].read_masks
            assert read is not None
            own, joined = read(), rows[..., level]
            assert torch.equal(own < 0, joined < 0)
            there = own >= 0
            assert torch.equal(
                scene.mask_vectors[own[there].long()], joint.mask_vectors[joined[there].long()]
            )
    areas = torch.zeros(len(joint.mask_areas))
    for view in joint.train:
        rows = view.read_masks().flatten()  # type: ignore[misc]
        areas += torch.bincount(rows[rows >= 0].long(), minlength=len(areas))
    assert torch.equal(areas, joint.mask_areas)


@pytest.mark.parametrize(("indicator", "shape"), [("learned", (400,)), ("per_level", (400, 3))])
def test_shapes(scenes: list[Scene], indicator: str, shape: tuple[int, ...]):
    module = module_of(join_levels(scenes), f"indicator={indicator}")
    n = module.model.count
    assert module.model.levels == 3
    assert module.model.splats["features"].shape == (n, 9)
    assert module.model.splats["indicator_logits"].shape == (n, *shape[1:])
    target = module.views[0]
    assert target.codes.shape == (36, 48 * 3, 3)
    assert target.valid.shape == (36, 48 * 3)
    render = module.model.render(target.view.camera)
    assert render.color is not None
    assert render.feature is not None
    assert render.color.shape == (36, 48, 3)
    assert render.feature.shape == (36, 48, 9)


@pytest.mark.parametrize("indicator", ["learned", "per_level"])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_codes_of_a_level_learn_from_its_masks_alone(
    scenes: list[Scene], level: int, indicator: str
):
    # Without fusion; with it, levels see each other as colour and language do.
    joint = join_levels(with_masks_at(scenes, level))
    options = ("fusion=none", f"indicator={indicator}")
    module = stirred(module_of(joint, *options))
    module.training_step(0, 0)
    gradients = module.model.splats["features"].grad
    assert gradients is not None
    moved = gradients.abs().sum(dim=0).unflatten(0, (3, 3)).sum(dim=1) > 0
    assert moved.tolist() == [place == level for place in range(3)]
    if indicator == "per_level":
        weights = module.model.splats["indicator_logits"].grad
        assert weights is not None
        assert (weights.abs().sum(dim=0) > 0).tolist() == moved.tolist()


@pytest.mark.parametrize("indicator", ["learned", "per_level"])
def test_three_equal_levels_are_one_model(scenes: list[Scene], indicator: str):
    # The mean over levels of one loss: the gradients of what is shared are those of one level, those of a level a third.
    options = ("fusion=none", "blend=fixed")
    one = stirred(module_of(scenes[2], *options))
    three = stirred(module_of(join_levels([scenes[2]] * 3), *options, f"indicator={indicator}"))
    # The heads were fitted to one set of vectors, listed once and thrice.
    three.model.head.load_state_dict(one.model.head.state_dict())  # type: ignore[operator]
    given, skip = three.step.setup, three.settings.skip
    setup = bind(given.objectives, given.views.scene, three.model, given.blend, skip, 0)
    three.step.setup = setup
    for module in (one, three):
        module.training_step(0, 0)
    assert one.report.log["blend_weight"] > 0
    # float32 sums over three times as many terms: 2e-7 measured.
    assert three.report.loss == pytest.approx(one.report.loss, rel=1e-5)
    for name, parameter in one.model.splats.items():
        want, got = parameter.grad, three.model.splats[name].grad
        assert (want is None) == (got is None)
        if want is None or got is None:
            continue
        if name == "features":
            got, want = got.unflatten(1, (3, 3)), want[:, None] / 3
        elif got.dim() > want.dim():
            got, want = got, want[:, None] / 3
        error = (got - want).norm() / (want.expand_as(got).norm() + 1e-30)
        assert error < 1e-4, (name, error)


def test_a_level_is_rendered_and_asked_as_if_it_were_alone(scenes: list[Scene]):
    camera = scenes[0].test[0].camera
    for overrides in (
        ("fusion=self", "fusion.init=xavier"),
        ("indicator=per_level", "fusion=cross", "fusion.init=xavier"),
        ("gaussians.color=evaluated", "fusion=self", "fusion.init=xavier"),
        ("indicator=opacity", "fusion=none", "sharing=pos"),
    ):
        model = stirred(module_of(join_levels(scenes), *overrides)).model
        with torch.no_grad():
            model.splats["features"].add_(torch.arange(9) * 0.1)  # levels differ
            whole = model.render(camera)
            assert whole.feature is not None
        field, words = SplatField(model), model.head.decode(torch.randn(4, 3))
        together = field.render(camera, frozenset({"color", "feature"}))
        for level, alone in enumerate(field.levels()):
            image = alone.render(camera, frozenset({"color", "alpha", "feature"}))
            assert torch.equal(image.color, whole.color)  # type: ignore[arg-type]
            assert torch.equal(image.alpha, whole.alpha_color)  # type: ignore[arg-type]
            assert torch.equal(image.feature[0], whole.feature[..., 3 * level : 3 * level + 3])  # type: ignore[index]
            found = field.similarity(camera, words, together)[level]
            assert torch.equal(alone.similarity(camera, words)[0], found)
            assert isinstance(alone, HasGaussians)
            assert alone.language_weights().dim() == 1
            of_gaussians = field.gaussian_similarity(words)[level]
            assert torch.equal(alone.gaussian_similarity(words)[0], of_gaussians)
            some = torch.tensor([3, 700, 41])
            picked = field.similarity(camera, words, pixels=some)[level, :, 0]
            torch.testing.assert_close(picked, found.flatten(1)[:, some])
    with pytest.raises(ValueError, match="level must be below 3, got 3"):
        SplatField(model, level=3)


@pytest.mark.parametrize("overrides", with_slow([(), ("indicator=per_level", "fusion=none")], [()]))
@pytest.mark.usefixtures("unchecked")
def test_resume_is_bit_identical(scenes: list[Scene], tmp_path: Path, overrides: tuple[str, ...]):
    joint, options = join_levels(scenes), (*overrides, *DENSIFY)
    whole = train(module_of(joint, *options), tmp_path / "whole")
    first = module_of(joint, *options)
    original = first.training_step

    def stopping(step: int, batch_idx: int) -> None:
        original(step, batch_idx)
        first.trainer.should_stop = step + 1 == 9

    first.training_step = stopping  # type: ignore[method-assign]
    train(first, tmp_path / "parts")
    assert first.next_step == 9
    second = train(module_of(joint, *options), tmp_path / "parts")
    assert second.next_step == 24
    assert whole.model.count != len(joint.points)  # it densified
    one, two = whole.model.state_dict(), second.model.state_dict()
    assert one.keys() == two.keys()
    assert not [key for key in one if not torch.equal(one[key], two[key])]


@pytest.mark.usefixtures("unchecked")
def test_training_learns_every_level(scenes: list[Scene], tmp_path: Path):
    module = module_of(join_levels(scenes), "trainer.iterations=120", "indicator=per_level")

    def errors() -> list[float]:
        target = module.views[0]
        with torch.no_grad():
            seen = module.model.render(target.view.camera).feature
        assert seen is not None
        gap = (seen.view_as(target.codes) - target.codes).square().sum(dim=-1)
        levels = (slice(level, None, 3) for level in range(3))
        return [float(gap[:, own][target.valid[:, own]].mean()) for own in levels]

    before = errors()
    train(module, tmp_path)
    assert all(after < 0.7 * start for after, start in zip(errors(), before, strict=True))


def test_codes_are_lifted_level_by_level(scenes: list[Scene]):
    options, head = ("fusion=none", "gaussians.init_features=lifted"), Identity(512)
    alone = [module_of(scene, *options, head=head).model.splats["features"] for scene in scenes]
    for indicator in ("learned", "per_level"):
        joint = module_of(join_levels(scenes), *options, f"indicator={indicator}", head=head)
        got = joint.model.splats["features"].unflatten(1, (3, 512))
        torch.testing.assert_close(got, torch.stack(alone, dim=1), rtol=1e-5, atol=1e-6)


def test_a_level_that_needs_a_gaussian_keeps_it(scenes: list[Scene]):
    module = module_of(join_levels(scenes), "indicator=per_level")
    splats = module.model.splats
    with torch.no_grad():
        splats["opacity_logits"].fill_(-9)
        splats["indicator_logits"].fill_(-9)
        splats["indicator_logits"][100:, 1] = 0
    count = module.model.count
    state = DensifyState.zeros(count)
    report = densify(
        splats, module.optimizer, state, module.densifying.config, module.densifying.extent, 0, 100
    )
    assert report.count == count - 100
    assert splats["indicator_logits"].shape == (count - 100, 3)


def test_ply_and_number_of_indicators(scenes: list[Scene], tmp_path: Path):
    splats = stirred(module_of(join_levels(scenes), "indicator=per_level")).model.splats
    write_ply(tmp_path / "a.ply", splats)
    back = read_ply(tmp_path / "a.ply")
    assert all(torch.equal(back[name], splats[name]) for name in splats)
    one = torch.full((4,), logit(0.3))
    several = at_levels(one, 3)
    assert several.shape == (4, 3)
    assert torch.equal(at_levels(several, 3), several)
    for levels in (None, 2):
        torch.testing.assert_close(at_levels(several, levels).reshape(4, -1)[:, 0], one)


def test_kept_weights_render_all_levels(scenes: list[Scene]):
    frozen = "trainer.freeze=[means,quats,log_scales,opacity_logits,indicator_logits]"
    for indicator in ("learned", "opacity", "per_level"):
        options = ("fusion=none", "gaussians.densify.stop=0", frozen, f"indicator={indicator}")
        kept = stirred(module_of(join_levels(scenes), *options))
        full = stirred(
            module_of(join_levels(scenes), *options, "trainer.skip.frozen_weights=false")
        )
        for step in range(2):
            kept.training_step(step, 0)
            full.training_step(step, 0)
        got, want = kept.model.splats["features"].grad, full.model.splats["features"].grad
        torch.testing.assert_close(got, want, rtol=1e-3, atol=1e-8)


def test_what_one_level_shows_is_shown(scenes: list[Scene]):
    module = module_of(join_levels(scenes), "indicator=per_level", "gaussians.prune_on=indicator")
    logits = module.model.splats["indicator_logits"]
    with torch.no_grad():
        logits[:] = logit(1e-4)
    assert most_shown(module).count_nonzero() == 0  # below `RasterConfig.alpha_min`
    shown = []
    for level in range(3):
        with torch.no_grad():
            logits[:] = logit(1e-4)
            logits[:, level] = logit(0.5)
        shown.append(most_shown(module))
    assert shown[0].count_nonzero() > 100
    assert torch.equal(shown[0], shown[1])
    assert torch.equal(shown[1], shown[2])
