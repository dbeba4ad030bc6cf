"""Depth: values worked by hand, the dense reference, gradients, and the same bits for any number of threads."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from instruction_sets import require_other
from render_hard_scenes import HARD_SCENES
from render_scenes import RenderScene, camera_at_origin, random_splats, sure_pixels
from torch import Tensor

from vlgs.ops import rasterize_reference as reference
from vlgs.ops.depth import render_depth
from vlgs.types import Camera, DepthKind, RasterConfig

KINDS: tuple[DepthKind, ...] = get_args(DepthKind)
NAMES = ("means", "quats", "scales", "opacities")


def depth_of(
    splats: RenderScene, kind: DepthKind, backend: str = "cpu", config: RasterConfig | None = None
) -> tuple[Tensor, dict[str, Tensor]]:
    """The depth image, and the gradients of a random linear function of it."""
    inputs = [splats.means, splats.quats, splats.scales, splats.weights[0]]
    means, quats, scales, weight = leaves = [t.detach().clone().requires_grad_() for t in inputs]
    config = config or RasterConfig()
    if backend == "cpu":
        depth = render_depth(
            means,
            quats,
            scales,
            weight,
            splats.viewmat,
            splats.K,
            splats.width,
            splats.height,
            config,
            kind,
        )
    else:
        camera = Camera(splats.viewmat, splats.K, splats.width, splats.height)
        depth = reference.render_depth(means, quats, scales, weight, camera, config, kind)
    upstream = torch.randn(depth.shape, generator=torch.Generator().manual_seed(5)).to(depth)
    grads = torch.autograd.grad(depth, leaves, upstream, allow_unused=True)
    filled = (torch.zeros_like(t) if g is None else g for t, g in zip(leaves, grads, strict=True))
    return depth.detach(), dict(zip(NAMES, filled, strict=True))


def assert_agree(splats: RenderScene, config: RasterConfig | None = None) -> None:
    """Float64: equal up to rounding."""
    for kind in KINDS:
        got, got_grads = depth_of(splats, kind, "cpu", config)
        want, want_grads = depth_of(splats, kind, "reference", config)
        torch.testing.assert_close(got, want, rtol=1e-11, atol=1e-10)
        for name, grad in want_grads.items():
            bound = 1e-10 * max(grad.abs().max().item(), 1.0)
            torch.testing.assert_close(got_grads[name], grad, rtol=1e-8, atol=bound)


def stack(depths: list[float], opacities: list[float]) -> RenderScene:
    """Gaussians of 0.1 on the optical axis, seen by the middle one of 3x3 pixels."""
    n = len(depths)
    means = torch.zeros(n, 3).double()
    means[:, 2] = torch.tensor(depths)
    K = torch.tensor([[20.0, 0, 1.5], [0, 20, 1.5], [0, 0, 1]]).double()
    return RenderScene(
        means, torch.tensor([[1.0, 0, 0, 0]]).double().expand(n, 4), torch.full((n, 3), 0.1).double(),
        (torch.tensor(opacities).double(),), (), torch.eye(4).double(), K, 3, 3,
    )  # fmt: skip


def test_one_behind_another():
    splats = stack([4.0, 2.0, 3.0], [0.9, 0.25, 0.4])  # weights 0.9 * 0.75 * 0.6, 0.25, 0.75 * 0.4
    accumulated = 0.25 * 2 + 0.3 * 3 + 0.405 * 4
    assert depth_of(splats, "accumulated")[0][1, 1].item() == pytest.approx(accumulated)
    assert depth_of(splats, "expected")[0][1, 1].item() == pytest.approx(accumulated / 0.955)
    # Left behind them: 0.75, 0.45, 0.045.
    assert depth_of(splats, "median")[0][1, 1].item() == 3.0


def test_the_gradient_of_the_median_reaches_one_centre():
    splats = stack([4.0, 2.0, 3.0], [0.9, 0.25, 0.4])
    leaves = [splats.means.clone().requires_grad_(), splats.weights[0].clone().requires_grad_()]
    depth = render_depth(
        leaves[0], splats.quats, splats.scales, leaves[1], splats.viewmat, splats.K, 3, 3, kind="median"
    )  # fmt: skip
    by_means, by_opacity = torch.autograd.grad(depth[1, 1], leaves, allow_unused=True)
    assert by_means.tolist() == [[0, 0, 0], [0, 0, 0], [0, 0, 1]]
    assert by_opacity is None


def test_where_less_than_half_is_covered_there_is_no_median():
    faint = stack([2.0, 3.0], [0.2, 0.3])
    assert not depth_of(faint, "median")[0].any()
    assert depth_of(faint, "expected")[0].all()
    exact = stack([2.0, 3.0], [0.25, 0.5])
    assert depth_of(stack([2.0], [0.5]), "median")[0][1, 1] == 2.0, "half is enough"
    assert depth_of(exact, "median")[0][1, 1] == 3.0


@pytest.mark.parametrize("kind", KINDS)
def test_where_nothing_lies_it_is_zero(kind: DepthKind):
    behind = replace(stack([-2.0], [0.9]), height=5)
    depth, grads = depth_of(behind, kind)
    assert depth.shape == (5, 3)
    assert not depth.any()
    assert not any(g.any() for g in grads.values())
    assert not depth_of(stack([], []), kind)[0].any()


def test_a_mean_of_the_largest_numbers_is_one():
    largest = torch.finfo(torch.float32).max
    means, quats = torch.tensor([[0.0, 0.0, largest]] * 3), torch.eye(4)[:1].expand(3, 4)
    K = torch.tensor([[8.0, 0.0, 8.0], [0.0, 8.0, 8.0], [0.0, 0.0, 1.0]])
    scales, opacities = torch.full((3, 3), largest / 3), torch.tensor([0.8, 0.2, 0.6])
    depth = render_depth(means, quats, scales, opacities, torch.eye(4), K, 16, 16)
    assert depth.isfinite().all()
    assert (depth == largest).any()


@pytest.mark.parametrize("stop", ["after", "before"])
@pytest.mark.parametrize("first", [0, 12])
def test_random_scenes(first: int, stop: str):
    for seed in range(first, first + 12):
        splats = random_splats(
            n=[1, 5, 30, 80][seed % 4], seed=seed, spread=[0.3, 0.8, 1.5][seed % 3]
        )
        solid = replace(splats, weights=(splats.weights[0].sqrt(),))
        config = RasterConfig(stop=stop, transmittance_min=1e-4 if seed % 2 else 0.3)  # pyright: ignore[reportArgumentType]
        assert_agree(solid, config)


@pytest.mark.parametrize("stop", ["after", "before"])
def test_every_constant_is_respected(stop: str):
    config = RasterConfig(
        near=1.0, eps2d=1.7, alpha_min=0.05, alpha_max=0.4, transmittance_min=0.2, stop=stop,  # pyright: ignore[reportArgumentType]
    )  # fmt: skip
    for seed in range(6):
        splats = random_splats(40, seed)
        assert_agree(replace(splats, weights=(splats.weights[0].sqrt(),)), config)


@pytest.mark.parametrize("scene", HARD_SCENES)
def test_hard_scenes(scene: Callable[[], RenderScene]):
    assert_agree(scene(), RasterConfig(transmittance_min=1.1e-4))


def test_float32_within_its_promise():
    """Within 1e-5 of the depths, off the cutoffs and off pixels that are about half covered behind some Gaussian."""
    config = RasterConfig()
    for seed in range(12):
        splats = random_splats(n=[3, 30, 120][seed % 3], seed=1000 + seed)
        splats = replace(splats, weights=(splats.weights[0],), values=splats.values[:1])
        sure = sure_pixels(splats, config, band=1e-4)
        sure &= sure_pixels(splats, replace(config, transmittance_min=0.5), band=1e-4)
        for kind in KINDS:
            want, got = (
                depth_of(splats, kind, "reference")[0],
                depth_of(splats.to(torch.float32), kind)[0],
            )
            assert (got.double() - want)[sure].abs().max() < 1e-5 * splats.means.abs().max() * 4


@pytest.mark.parametrize("kind", KINDS)
def test_threads_and_repeats_do_not_change_a_bit(kind: DepthKind):
    splats = random_splats(6000, seed=1, channels=(1,), spread=0.3)
    splats = replace(
        splats, width=185, height=145, K=splats.K * torch.tensor([5.0, 5.0, 1.0])[:, None],
        scales=splats.scales / 3,
    ).to(torch.float32)  # fmt: skip
    results = []
    for threads in (1, 2, 3, 8, 1):
        torch.set_num_threads(threads)
        depth, grads = depth_of(splats, kind)
        results.append([depth, *grads.values()])
    assert (results[0][0] > 0).float().mean() > 0.2
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], result, strict=True))


SCRIPT = """
import sys
sys.path[:0] = sys.argv[1:]
import torch
from render_scenes import random_splats
from test_render_depth import assert_agree
torch.set_num_threads(1)
assert_agree(random_splats(60, seed=3))
from test_render_depth import test_float32_within_its_promise
test_float32_within_its_promise()
from vlgs.ops import _csrc
print(_csrc.isa())
"""


@pytest.mark.parametrize("isa", ["base", "v3", "v4"])
def test_every_instruction_set_draws_the_reference(isa: str):
    require_other(isa)
    folder = Path(__file__).parent
    command = [sys.executable, "-c", SCRIPT, folder, folder.parent]
    environment = os.environ | {"VLGS_ISA": isa}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == isa


def test_bad_input_is_named():
    viewmat, K = camera_at_origin()
    good = random_splats(3, seed=0)
    tensors = good.means, good.quats, good.scales, good.weights[0]
    # Tests check the type of arguments before the function can; without that it is a ValueError.
    with pytest.raises((ValueError, TypeError), match="kind"):
        render_depth(*tensors, viewmat, K, 4, 4, kind="mean")  # pyright: ignore[reportArgumentType]
    for kind in KINDS:
        with pytest.raises(ValueError, match=r"weight must be in \[0, 1\]"):
            render_depth(*tensors[:3], tensors[3] + 1, viewmat, K, 4, 4, kind=kind)
        broken = tensors[0].clone()
        broken[1, 0] = torch.nan
        with pytest.raises(ValueError, match="means must be finite"):
            render_depth(broken, *tensors[1:], viewmat, K, 4, 4, kind=kind)
