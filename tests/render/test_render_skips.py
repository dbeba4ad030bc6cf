"""What the rasterizer leaves out: nothing is lost where `vlgs.skips` says exact, and no more than its bound elsewhere."""

from dataclasses import replace

import pytest
import torch
from render_scenes import RenderScene, random_splats, render, render_with_gradients
from torch import Tensor

from vlgs.skips import SKIPS, named
from vlgs.types import RasterConfig

SAME_BITS = [
    skip.setting.removeprefix("raster.")
    for skip in SKIPS
    if skip.setting.startswith("raster.") and skip.bound == "same bits"
]


def many(channels: tuple[int, ...], dtype: torch.dtype) -> RenderScene:
    """Long, thin and faint ones among them, which boxes and fixed extents fit badly."""
    return random_splats(400, seed=11, channels=channels, spread=1.2).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [(3, 3), (3, 7)])
@pytest.mark.parametrize("switches", [*([name] for name in SAME_BITS), SAME_BITS], ids="+".join)
def test_trimming_the_lists_does_not_change_a_bit(
    switches: list[str], channels: tuple[int, ...], dtype: torch.dtype
):
    splats = many(channels, dtype)
    assert {"tile_test", "block_masks", "opacity_extent"} == set(SAME_BITS)
    without = RasterConfig(**dict.fromkeys(switches, False))  # pyright: ignore[reportArgumentType]
    want, want_grads = render_with_gradients(splats)
    got, got_grads = render_with_gradients(splats, config=without)
    pairs = [*zip(got.images, want.images, strict=True), *zip(got.alphas, want.alphas, strict=True)]
    assert all(torch.equal(a, b) for a, b in pairs)
    assert torch.equal(got.visible, want.visible)
    assert 0 < want.visible.sum() < len(splats.means)
    for name, gradient in want_grads.items():
        assert torch.equal(got_grads[name], gradient), name


@pytest.mark.parametrize("channels", [(3, 3), (3, 5), (3, 3, 3)])
def test_a_shared_chain_is_as_many_equal_chains(channels: tuple[int, ...]):
    splats = many(channels, torch.float64)
    splats = replace(splats, weights=(splats.weights[0],) * len(channels))
    want, want_grads = render_with_gradients(splats, config=RasterConfig(share_chains=False))
    got, got_grads = render_with_gradients(splats)
    for a, b in zip((*got.images, *got.alphas), (*want.images, *want.alphas), strict=True):
        assert torch.equal(a, b)
    for name, gradient in want_grads.items():  # added up in another order
        error = (got_grads[name] - gradient).norm() / gradient.norm()
        assert error < 1e-13, name


def stack(layers: int, weight: float) -> RenderScene:
    """Wide Gaussians one behind the other, with values of 1 from the second on: what is left out is seen."""
    one = random_splats(layers, seed=0, channels=(1,))
    means = torch.zeros(layers, 3).double()
    means[:, 2] = torch.linspace(2, 3, layers).double()
    return replace(
        one, means=means, scales=torch.full((layers, 3), 5.0).double(), viewmat=torch.eye(4).double(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).double().repeat(layers, 1),
        weights=(torch.full((layers,), weight).double(),),
        values=(torch.ones(layers, 1).double(),),
    )  # fmt: skip


def lost(splats: RenderScene, config: RasterConfig) -> float:
    whole, _ = render(splats, config=replace(config, transmittance_min=0.0))
    early, _ = render(splats, config=config)
    values = max(float(v.abs().max()) for v in splats.values)
    errors: list[Tensor] = [
        (a - b).detach().abs().max() for a, b in zip(early.images, whole.images, strict=True)
    ]
    return float(torch.stack(errors).max()) / values


@pytest.mark.parametrize("threshold", [1e-4, 1e-2, 0.1])
@pytest.mark.parametrize("stop", ["after", "before"])
@pytest.mark.parametrize("weight", [0.3, 0.9, 0.99, 1.0])
def test_an_early_stop_stays_within_its_bound(threshold: float, stop: str, weight: float):
    assert "transmittance_min * largest value" in named("early_stop").bound
    config = RasterConfig(transmittance_min=threshold, stop=stop)  # pyright: ignore[reportArgumentType]
    bound = threshold if stop == "after" else threshold / (1 - config.alpha_max)
    bound = min(bound, 1.0)
    for splats in (stack(40, weight), many((3, 3), torch.float64)):
        assert lost(splats, config) <= bound * (1 + 1e-9)


def test_the_bounds_are_near():
    """Neither is loose: 40 layers of 0.99 lose nearly all that "before" may lose, layers of 0.9 a part of "after"."""
    before = RasterConfig(transmittance_min=1e-4 * 0.999, stop="before")
    assert lost(stack(40, 1.0), before) <= 1e-4 * 0.999 / 0.01
    assert lost(stack(40, 0.989), RasterConfig(transmittance_min=2e-4, stop="before")) > 1e-2
    after = RasterConfig(transmittance_min=1.001e-4)
    assert lost(stack(40, 0.9), after) > 0.9e-4
    # The bound of "after" is not one of "before": pitfall of everyone's early stop.
    assert lost(stack(40, 0.9), replace(after, stop="before")) > 1.001e-4
