"""sharing=pos: language blended with covariances of its own, around the same centres."""

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from tiny_runs import TINY, composed

from vlgs import ChannelGroup, RasterConfig, rasterize
from vlgs.config import instantiate
from vlgs.gaussians import (
    DensifyState,
    GaussiansConfig,
    attributes_of,
    conform,
    densify,
    read_ply,
    write_ply,
)
from vlgs.runs import RunFolder
from vlgs.training.build import Parts, build_module
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.training.sharing import choose_sharing
from vlgs.types import Camera, Covariance, Scene

CAMERA = Camera(
    torch.eye(4).double(), torch.tensor([[30.0, 0, 17], [0, 33, 15], [0, 0, 1]]).double(), 37, 29
)
SMOOTH = RasterConfig(alpha_min=1e-12, transmittance_min=0.0)


def leaves(n: int, seed: int = 0) -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    return {
        "means": normal(n, 3) * 0.5 + torch.tensor([0, 0, 2.5]).double(),
        "quats": normal(n, 4),
        "scales": torch.exp(0.5 * normal(n, 3) - 2),
        "own_quats": normal(n, 4),
        "own_scales": torch.exp(0.5 * normal(n, 3) - 2),
        "color": normal(n, 3),
        "code": normal(n, 2),
        "opacity": torch.rand(n, generator=rng).double() * 0.9,
        "indicator": torch.rand(n, generator=rng).double() * 0.9,
    }


def render(t: dict[str, torch.Tensor], backend: str = "cpu", config: RasterConfig | None = None):
    groups = [
        ChannelGroup(t["color"], t["opacity"]),
        ChannelGroup(t["code"], t["indicator"], shape=Covariance(t["own_quats"], t["own_scales"])),
    ]
    return rasterize(
        t["means"], t["quats"], t["scales"], groups, CAMERA.viewmat, CAMERA.K, CAMERA.width,
        CAMERA.height, config or RasterConfig(), backend,  # pyright: ignore[reportArgumentType]
    )  # fmt: skip


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_equal_shape_gives_the_bits_of_the_shared_one(dtype: torch.dtype):
    t = {name: value.to(dtype) for name, value in leaves(60).items()}
    own = render(t | {"own_quats": t["quats"].clone(), "own_scales": t["scales"].clone()})
    groups = [ChannelGroup(t["color"], t["opacity"]), ChannelGroup(t["code"], t["indicator"])]
    camera = CAMERA.viewmat, CAMERA.K, CAMERA.width, CAMERA.height
    shared = rasterize(t["means"], t["quats"], t["scales"], groups, *camera)
    for mine, theirs in zip(
        (*own.images, *own.alphas, own.visible, own.mean2d),
        (*shared.images, *shared.alphas, shared.visible, shared.mean2d),
        strict=True,
    ):
        assert torch.equal(mine, theirs)


def test_the_kernel_is_the_reference():
    t = leaves(60)
    t["quats"][3] = t["own_quats"][5] = 0  # left out everywhere, and out of language
    got, want = render(t), render(t, "reference")
    torch.testing.assert_close(got.images, want.images, rtol=0, atol=1e-9)
    torch.testing.assert_close(got.alphas, want.alphas, rtol=0, atol=1e-9)
    assert torch.equal(got.visible, want.visible)
    other = render(t | {"own_scales": 2 * t["own_scales"]})
    assert torch.equal(other.images[0], got.images[0])
    assert not torch.equal(other.images[1], got.images[1])


def test_gradients_against_finite_differences():
    t = leaves(4, seed=3)
    small = replace(CAMERA, width=6, height=5)
    K = torch.tensor([[6.0, 0, 2.5], [0, 7, 3], [0, 0, 1]]).double()

    def images(*values: torch.Tensor):
        t = dict(zip(names, values, strict=True))
        own = Covariance(t["own_quats"], t["own_scales"])
        groups = [
            ChannelGroup(t["color"], t["opacity"]),
            ChannelGroup(t["code"], t["indicator"], shape=own),
        ]
        out = rasterize(t["means"], t["quats"], t["scales"], groups, small.viewmat, K, 6, 5, SMOOTH)
        return (*out.images, *out.alphas, out.mean2d)

    names = list(t)
    assert torch.autograd.gradcheck(images, [value.requires_grad_() for value in t.values()])


def test_one_mean2d_gathers_the_gradient_of_both_shapes():
    t = {name: value.requires_grad_() for name, value in leaves(30).items()}
    out = render(t)
    gradients = [
        torch.autograd.grad(loss, out.mean2d, retain_graph=True)[0]
        for loss in (
            out.images[0].square().sum(),
            out.images[1].square().sum(),
            out.images[0].square().sum() + out.images[1].square().sum(),
        )
    ]
    assert all(gradient.any() for gradient in gradients)
    torch.testing.assert_close(gradients[0] + gradients[1], gradients[2])


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_broken_shape_is_named(backend: str):
    t = leaves(5)
    with pytest.raises(ValueError, match=r"groups\[1\].shape.quats must be of shape \('n', 4\)"):
        render(t | {"own_quats": t["own_quats"][:3], "own_scales": t["own_scales"][:3]}, backend)
    t["own_scales"][2, 1] = float("nan")
    with pytest.raises(ValueError, match=r"shape.*row 2|row 2.*own shape"):
        render(t, backend)


def params_of(scales: list[float], language: list[float]) -> torch.nn.ParameterDict:
    n = len(scales)
    values = {
        "means": torch.zeros(n, 3),
        "quats": torch.eye(4)[:1].repeat(n, 1),
        "log_scales": torch.tensor(scales).log()[:, None].repeat(1, 3),
        "sh0": torch.zeros(n, 3),
        "shN": torch.zeros(n, 0, 3),
        "opacity_logits": torch.zeros(n),
        "indicator_logits": torch.zeros(n),
        "features": torch.zeros(n, 3),
        "language_quats": torch.eye(4)[:1].repeat(n, 1),
        "language_log_scales": torch.tensor(language).log()[:, None].repeat(1, 3),
    }
    return torch.nn.ParameterDict({k: torch.nn.Parameter(v) for k, v in values.items()})


def test_the_larger_shape_decides_and_children_shrink_in_both():
    params = params_of([0.001] * 17 + [0.1], [0.1] + [0.001] * 16 + [0.001])
    optimizer = torch.optim.Adam([{"params": [v], "name": k} for k, v in params.items()])
    hot = DensifyState(torch.ones(18), torch.ones(18))
    report = densify(params, optimizer, hot, GaussiansConfig(), 1.0, 0, 600)
    assert (report.split, report.cloned) == (2, 16)
    children = params["language_log_scales"][-4:, 0].detach().exp()
    torch.testing.assert_close(children, torch.tensor([0.1, 0.001, 0.1, 0.001]) / 1.6)
    assert {len(value) for value in params.values()} == {16 + 16 + 4}
    with torch.no_grad():
        params["language_quats"][3] = 0
    report = densify(params, optimizer, DensifyState.zeros(36), GaussiansConfig(), 1.0, 0, 700)
    assert report.pruned == 1


def test_ply_keeps_both_shapes(tmp_path: Path):
    params = dict(params_of([0.1] * 3, [0.2] * 3))
    write_ply(tmp_path / "a.ply", params)
    back = read_ply(tmp_path / "a.ply")
    assert back.keys() == params.keys()
    assert all(torch.equal(params[name], back[name]) for name in params)
    write_ply(tmp_path / "b.ply", params, "3dgs")
    assert "language_quats" not in read_ply(tmp_path / "b.ply")
    assert conform(back, attributes_of(GaussiansConfig(), 3)).keys() == back.keys() - {
        "language_quats",
        "language_log_scales",
    }


def module_of(scene: Scene, *overrides: str) -> VLGSModule:
    config = composed(*TINY, "trainer=smoke", "sharing=pos", *overrides)
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, config.seed)


SHORT = (
    "trainer.iterations=24",
    "gaussians.densify={start: 2, stop: 22, every: 4, reset_every: 12}",
    "gaussians.densify.grad_threshold=1e-6",
)


@pytest.mark.usefixtures("unchecked")
def test_training_moves_both_shapes_and_resumes_bit_for_bit(tiny_scene: Scene, tmp_path: Path):
    whole = module_of(tiny_scene, *SHORT)
    fit(whole, RunFolder(tmp_path / "whole"), FitOptions(meta={}, progress=False))
    first = module_of(tiny_scene, *SHORT)
    original = first.training_step

    def stopping(step: int, batch_idx: int) -> None:
        original(step, batch_idx)
        first.trainer.should_stop = step == 12

    first.training_step = stopping  # type: ignore[method-assign]
    fit(first, RunFolder(tmp_path / "parts"), FitOptions(meta={}, progress=False))
    assert first.next_step == 13
    second = module_of(tiny_scene, *SHORT)
    fit(second, RunFolder(tmp_path / "parts"), FitOptions(meta={}, progress=False))
    splats = whole.model.splats
    assert whole.model.count != len(tiny_scene.points)
    assert all(torch.equal(splats[name], second.model.splats[name]) for name in splats)
    assert not torch.equal(splats["log_scales"], splats["language_log_scales"])
    assert not torch.equal(splats["quats"], splats["language_quats"])


@pytest.mark.parametrize("frozen", [True, False])
def test_kept_weights_are_those_of_both_shapes(tiny_scene: Scene, frozen: bool):
    names = ["means", "quats", "log_scales", "language_quats", "language_log_scales", "sh0", "shN"]
    freeze = f"trainer.freeze=[{','.join([*names, 'opacity_logits', 'indicator_logits'])}]"
    module = module_of(
        tiny_scene,
        "fusion=none",
        "gaussians.densify.stop=0",
        freeze,
        f"trainer.skip.frozen_weights={str(frozen).lower()}",
    )
    with torch.no_grad():
        module.model.splats["language_log_scales"] += 0.5
        module.model.splats["features"].fill_(0.3)
    fused, target = module.model.fuse(), module.views[0]
    kept = module.step.render(0, target, fused)
    plain = module.model.render(target.view.camera, fused=fused)
    assert (module.step.frozen is not None) == frozen
    assert kept.feature is not None
    assert plain.feature is not None
    torch.testing.assert_close(kept.feature, plain.feature, rtol=0, atol=1e-5)
    torch.testing.assert_close(kept.color, plain.color, rtol=0, atol=1e-5)


def test_what_is_not_shared_by_position_is_not_shared_by_shape():
    with pytest.raises(ValueError, match="covariances must be false where means is false"):
        choose_sharing(means=False, covariances=True)
