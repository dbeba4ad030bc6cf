"""The kernel against the dense reference: values and every gradient."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from render_hard_scenes import HARD_SCENES
from render_scenes import (
    RenderScene,
    random_splats,
    relative_error,
    render_with_gradients,
    sure_pixels,
)
from slow import with_slow
from torch import Tensor

from vlgs.types import RasterConfig

BLURS = (0.3, 0.1)
"""That of 3DGS and the paper, and that of everyday trainers, with which conics are up to three times as steep."""


def assert_agree(splats: RenderScene, config: RasterConfig | None = None) -> None:
    """Float64: equal up to rounding, whatever the scene."""
    got, got_grads = render_with_gradients(splats, "cpu", config)
    want, want_grads = render_with_gradients(splats, "reference", config)
    for a, b in zip(got.images + got.alphas, want.images + want.alphas, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)
    assert torch.equal(got.visible, want.visible)
    torch.testing.assert_close(got.mean2d, want.mean2d, rtol=1e-12, atol=1e-11)
    for name, grad in want_grads.items():
        scale = grad.abs().max().item()
        torch.testing.assert_close(
            got_grads[name],
            grad,
            rtol=1e-8,
            atol=1e-10 * max(scale, 1.0),
            msg=lambda m, n=name: f"{n}: {m}",
        )


@pytest.mark.parametrize("stop", ["after", "before"])
@pytest.mark.parametrize("first", with_slow(range(0, 120, 20), (60, 80, 100)))
def test_random_scenes(first: int, stop: str):
    for seed in range(first, first + 20):
        splats = random_splats(
            n=[1, 5, 30, 80][seed % 4], seed=seed, spread=[0.3, 0.8, 1.5][seed % 3]
        )
        assert_agree(splats, RasterConfig(stop=stop))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "channels", [(1,), (3,), (16,), (40,), (512,), (3, 16), (1, 2, 3, 4, 5), (7, 512)]
)
def test_any_number_of_groups_and_channels(channels: tuple[int, ...]):
    assert_agree(random_splats(25, seed=len(channels), channels=channels))


def test_groups_with_one_weight_tensor():
    splats = random_splats(30, seed=3, channels=(3, 5, 3))
    a, b, _ = splats.weights
    assert_agree(replace(splats, weights=(a, b, a)))


@pytest.mark.parametrize("shape_grads", [(True, False), (False, True), (False, False)])
def test_a_group_may_leave_the_shape_alone(shape_grads: tuple[bool, bool]):
    splats = replace(random_splats(30, seed=4), shape_grads=shape_grads)
    assert_agree(splats)
    assert_agree(replace(splats, weights=splats.weights[:1] * 2))


def test_every_constant_is_respected():
    config = RasterConfig(
        near=1.0, eps2d=1.7, alpha_min=0.05, alpha_max=0.6, transmittance_min=0.2, fov_margin=0.1
    )
    for seed in range(10):
        assert_agree(random_splats(40, seed), config)
        assert_agree(random_splats(40, seed), replace(config, stop="before"))


@pytest.mark.parametrize("eps2d", BLURS)
@pytest.mark.parametrize("stop", ["after", "before"])
@pytest.mark.parametrize("scene", HARD_SCENES)
def test_hard_scenes(scene: Callable[[], RenderScene], stop: str, eps2d: float):
    # Not 1e-4: two layers of alpha 0.99 leave just that, and rounding would decide whether the third is drawn.
    config = RasterConfig(stop=stop, transmittance_min=1.1e-4, eps2d=eps2d)  # pyright: ignore[reportArgumentType]
    assert_agree(scene(), config)


@pytest.mark.parametrize("eps2d", with_slow(BLURS, BLURS[1:]))
def test_float32_within_its_promise(eps2d: float):
    """Images within 1e-5, gradients within 1e-3 and 0.99999 in direction, off the cutoffs."""
    config = RasterConfig(eps2d=eps2d)
    for seed in range(60):
        splats = random_splats(n=[3, 30, 120][seed % 3], seed=1000 + seed)
        sure = sure_pixels(splats, config, band=1e-4)
        want, want_grads = render_with_gradients(splats, "reference", config, sure.double())
        got, got_grads = render_with_gradients(
            splats.to(torch.float32), "cpu", config, sure.double()
        )
        for a, b in zip(got.images + got.alphas, want.images + want.alphas, strict=True):
            assert (a.double() - b)[sure].abs().max() < 1e-5
        for name, grad in want_grads.items():
            assert relative_error(got_grads[name].double(), grad) < 1e-3, (seed, name)
            assert cosine(got_grads[name].double(), grad) > 0.99999, (seed, name)


@pytest.mark.parametrize("stop", ["after", "before"])
def test_float32_keeps_its_promise_where_no_light_is_left(stop: str):
    """Without the early stop, what is left behind forty opaque layers is below the smallest float32."""
    config = RasterConfig(transmittance_min=0.0, alpha_min=1e-6, stop=stop)  # pyright: ignore[reportArgumentType]
    splats = random_splats(n=40, seed=3)
    means = torch.zeros_like(splats.means)
    means[:, 2] = torch.linspace(2, 4, 40)
    scales = torch.full_like(splats.scales, 0.3) + 0.2 * splats.scales / splats.scales.max()
    weights = tuple(
        0.9 + 0.08 * w for w in splats.weights
    )  # below alpha_max, where the clamp decides
    viewmat = torch.eye(4).to(splats.viewmat)
    splats = replace(splats, means=means, scales=scales, weights=weights, viewmat=viewmat)
    _, want = render_with_gradients(splats, "cpu", config)
    _, got = render_with_gradients(splats.to(torch.float32), "cpu", config)
    for name, grad in want.items():
        assert relative_error(got[name].double(), grad) < 1e-3, name


def cosine(a: Tensor, b: Tensor) -> float:
    return (
        1.0 if not b.any() else float(torch.dot(a.flatten(), b.flatten()) / (a.norm() * b.norm()))
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_contributing_pixel_is_missed(dtype: torch.dtype):
    """Faint Gaussians hide nothing: one missing (pixel, Gaussian) costs at least 1/255 of accumulated weight."""
    config = RasterConfig()
    for seed in range(12):
        splats = random_splats(200, seed=seed, channels=(1,), spread=1.6)
        splats = replace(splats, weights=(splats.weights[0] * 0.02 + 0.003,))
        sure = sure_pixels(splats, config, band=2e-5)
        want, _ = render_with_gradients(splats, "reference", config)
        got, _ = render_with_gradients(splats.to(dtype), "cpu", config)
        assert sure.double().mean() > 0.5
        assert (got.alphas[0].double() - want.alphas[0])[sure].abs().max() < 2e-5
