"""3DGS, LangSplat and Feature-3DGS by their definitions: what each learns from, and what no gradient may reach."""

from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import pytest
import torch
from jaxtyping import Int
from slow import with_slow
from tiny_runs import TINY, composed
from torch import Tensor

from vlgs.config import instantiate
from vlgs.experiment import construct
from vlgs.fields.trained import SplatField
from vlgs.gaussians.attributes import SHORTEST
from vlgs.heads.linear import Linear
from vlgs.losses import l1_dssim
from vlgs.runs import RunFolder
from vlgs.training.build import Parts, build_module, scaled
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.fit import FitOptions
from vlgs.training.lightning import VLGSModule
from vlgs.training.separate import for_language, without_language
from vlgs.training.stages import Progress, run_stages
from vlgs.training.state import capture, restore
from vlgs.training.workshop import Workshop
from vlgs.types import Scene, View

KEPT = tuple(o for o in TINY if not o.startswith("head."))
QUICK = "head.training.steps=30"
SHAPE = ("means", "quats", "log_scales")


@pytest.fixture
def gaps(tiny_scene: Scene) -> Scene:
    """Without masks on the upper half of every view."""

    def upper(view: View) -> Int[Tensor, "h w"]:
        assert view.read_masks is not None
        masks = view.read_masks().clone()
        masks[: len(masks) // 2] = -1
        return masks

    train = (replace(view, read_masks=partial(upper, view)) for view in tiny_scene.train)
    return replace(tiny_scene, train=tuple(train))


def made(method: str, scene: Scene, folder: Path, *overrides: str) -> tuple[Progress, Workshop]:
    config = composed(*KEPT, f"method={method}", "trainer=smoke", *overrides)
    experiment = construct(config)
    options = FitOptions(meta={}, progress=False)
    workshop = Workshop(RunFolder(folder), experiment.make_parts, lambda: options, 0)
    return run_stages(experiment.stages(), {3: scene}, workshop), workshop


def module_of(method: str, scene: Scene, *overrides: str) -> VLGSModule:
    config = composed(*KEPT, f"method={method}", "trainer=smoke", *overrides)
    torch.manual_seed(0)
    parts = Parts(**{part.name: instantiate(config[part.name]) for part in fields(Parts)})
    return build_module(scene, parts, 0)


@pytest.mark.parametrize(
    "method",
    with_slow(
        ["best", "goi", "langsplat", "langsplat_v2", "lift"], ["goi", "langsplat_v2", "lift"]
    ),
)
def test_without_masks_what_colour_made_stays_as_it_is(
    tiny_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
):
    done: list[int] = []
    step_of = VLGSModule.training_step

    def stepping(self: VLGSModule, step: int, batch_idx: int) -> None:
        done.append(self.next_step)
        step_of(self, step, batch_idx)

    monkeypatch.setattr(VLGSModule, "training_step", stepping)
    silent = without_language(tiny_scene)
    progress, workshop = made(method, silent, tmp_path, "trainer.iterations=4")
    assert done == [0, 1, 2, 3]
    field = progress.field()
    assert isinstance(field, SplatField)
    assert not field.has_language
    geometry = workshop.made["geometry"].field
    assert isinstance(geometry, SplatField)
    for name in ("means", "quats", "log_scales", "sh0", "shN", "opacity_logits"):
        assert torch.equal(field.model.splats[name], geometry.model.splats[name]), name
    assert field.model.sh_degree == geometry.model.sh_degree
    again, _ = made(method, silent, tmp_path, "trainer.iterations=4")
    assert len(done) == 4, "what is made is read back"
    assert torch.equal(again.field().model.splats["sh0"], field.model.splats["sh0"])  # type: ignore[attr-defined]


def test_3dgs_learns_from_colour_alone(tiny_scene: Scene, tmp_path: Path):
    progress, _ = made("gs3d", tiny_scene, tmp_path, "trainer.iterations=4", QUICK)
    field = progress.field()
    assert isinstance(field, SplatField)
    assert not field.has_language
    assert not field.model.splats["features"].any()
    module = module_of("gs3d", tiny_scene, QUICK)
    done = module.step.forward(0)
    pairs = zip(done.seen.renders, done.seen.targets, strict=True)
    by_hand = sum(l1_dssim(render.color, target.image) for render, target in pairs)  # type: ignore[arg-type]
    torch.testing.assert_close(done.total, by_hand)


def test_langsplat_moves_codes_alone(tiny_scene: Scene, tmp_path: Path):
    progress, workshop = made("langsplat", tiny_scene, tmp_path, "trainer.iterations=6", QUICK)
    geometry, learned = progress.gaussians("geometry", 3), progress.gaussians("", 3)
    for name, value in learned.splats.items():
        assert torch.equal(value, geometry.splats[name]) == (name != "features"), name
    assert [workshop.made[name].kept for name in ("geometry", "")] == [False, True]
    codes = learned.fuse().feature
    length = codes.norm(dim=1)
    touched = learned.splats["features"].any(dim=1)
    assert touched.any()
    own = learned.splats["features"][touched].norm(dim=1)
    torch.testing.assert_close(length[touched], own / (own + SHORTEST))
    assert not length[~touched].any()
    assert learned.fuse().language_weight is not None
    assert torch.equal(learned.fuse().language_weight, learned.gaussians().opacities)


def test_langsplats_loss_counts_every_pixel(gaps: Scene):
    module = module_of("langsplat", gaps, QUICK)
    module.model.splats["features"].data.normal_()
    done = module.step.forward(0)
    for place, render, target in zip("12", done.seen.renders, done.seen.targets, strict=True):
        assert render.feature is not None
        total, count = 0.0, 0
        for shown, wanted, valid in zip(
            render.feature.flatten(0, 1).tolist(),
            target.codes.flatten(0, 1).tolist(),
            target.valid.flatten().tolist(),
            strict=True,
        ):
            total += sum(abs(a - b) for a, b in zip(shown, wanted, strict=True)) if valid else 0.0
            count += 3
        term = done.terms[f"language {place}"].detach()
        assert float(term) == pytest.approx(total / count, rel=1e-5)


def test_langsplat_of_equal_budget_halves_both_schedules(tiny_scene: Scene, tmp_path: Path):
    made("langsplat_equal", tiny_scene, tmp_path, "trainer.iterations=12", QUICK)
    for name in ("geometry", ""):
        checkpoint = load_checkpoint(RunFolder(tmp_path / name).checkpoint)
        assert checkpoint is not None
        assert checkpoint.step == 6
    parts = scaled(construct(composed(*KEPT, "trainer=paper")).parts, 0.5)
    assert parts.trainer.iterations == 7500
    assert parts.trainer.sh_every == 500
    densify = parts.gaussians.densify
    assert (densify.start, densify.stop, densify.reset_every, densify.every) == (
        250,
        7500,
        1500,
        100,
    )


def gradients(module: VLGSModule) -> dict[str, Tensor | None]:
    """Of language alone, with codes that are not zero."""
    module.model.splats["features"].data.normal_()
    done = module.step.forward(0)
    (done.total - done.color).backward()
    return {name: value.grad for name, value in module.model.splats.items()}


def test_feature_3dgs_language_moves_no_shape_and_no_opacity(tiny_scene: Scene):
    module = module_of("feature3dgs", tiny_scene)
    assert module.model.splats["features"].shape[1] == 128
    assert isinstance(module.model.head, Linear)
    assert module.model.head.map.weight.shape == (512, 128)
    found = gradients(module)
    assert found["features"] is not None
    assert found["features"].any()
    assert module.model.head.map.weight.grad is not None
    for name in (*SHAPE, "opacity_logits", "sh0"):
        gradient = found[name]
        assert gradient is None or not gradient.any(), name
    as_told = ("gaussians.codes_shape_grad=true", "indicator.detach=false")
    joint = gradients(module_of("feature3dgs", tiny_scene, *as_told))
    for name in (*SHAPE, "opacity_logits"):
        gradient = joint[name]
        assert gradient is not None, name
        assert gradient.any(), name


@pytest.mark.parametrize("pixels", ["valid", "all"])
def test_feature_3dgs_loss_is_that_of_decoded_pixels(gaps: Scene, pixels: str):
    module = module_of("feature3dgs", gaps, f"loss.language.pixels={pixels}")
    module.model.splats["features"].data.normal_()
    done = module.step.forward(0)
    for place, render, target in zip("12", done.seen.renders, done.seen.targets, strict=True):
        assert render.feature is not None
        decoded = module.model.head.predict(render.feature).double()
        wanted = torch.zeros_like(decoded)
        there = target.masks >= 0
        wanted[there] = gaps.mask_vectors[target.masks[there].long()].double()
        error = (decoded - wanted).abs().mean(dim=-1)[there]
        over = there.sum() if pixels == "valid" else there.numel()
        term = done.terms[f"language {place}"].detach()
        assert float(term) == pytest.approx(float(error.detach().sum() / over), rel=1e-4)


@pytest.mark.parametrize(
    ("overrides", "pruned_on"),
    [
        ((), "max"),
        (("indicator=opacity",), "opacity"),
        (("indicator=fixed", "indicator.value=0.5"), "opacity"),
        (("gaussians.prune_on=opacity",), "opacity"),
    ],
)
def test_a_weight_that_nothing_trains_keeps_no_gaussian_alive(
    tiny_scene: Scene, overrides: tuple[str, ...], pruned_on: str
):
    parts = construct(composed(*TINY, *overrides)).make_parts()
    assert build_module(tiny_scene, parts, 0).densifying.config.prune_on == pruned_on
    alone = for_language(parts)
    made = build_module(tiny_scene, alone, 0, color=False)
    assert made.densifying.config.prune_on == "indicator"


def test_colour_alone_carries_no_codes_that_nothing_reads(tiny_scene: Scene):
    """Codes of the method's width come with the stage that has language, at zero as before."""
    parts = construct(composed("method=lift")).parts
    silent = without_language(tiny_scene)
    assert build_module(silent, parts, seed=0).model.splats["features"].shape[1] == 512
    geometry = build_module(silent, parts, seed=0, codes=False)
    assert geometry.model.splats["features"].shape[1] == 1
    assert geometry.model.levels == 1
    lifted = build_module(tiny_scene, parts, 0, start=dict(geometry.model.splats))
    assert lifted.model.splats["features"].shape[1] == 512
    assert not lifted.model.splats["features"].any()
    # A checkpoint of before has codes of zeros.
    saved = capture(geometry, {})
    wide = saved.tensors | {"model.splats.features": torch.zeros(geometry.count, 512)}
    restore(geometry, replace(saved, tensors=wide))
    assert geometry.model.splats["features"].shape[1] == 1
    drawn = replace(parts, gaussians=replace(parts.gaussians, init_features="normal"))
    kept = build_module(silent, drawn, seed=0, codes=False)
    assert kept.model.splats["features"].shape[1] == 512, "a later stage goes on from these"
