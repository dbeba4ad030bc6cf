"""What nobody asks for is not computed, and what is asked for does not change by a bit."""

import itertools
from dataclasses import replace

import pytest
import torch
from render_scenes import RenderScene, random_splats, render
from torch import Tensor

from vlgs.ops.rasterize import rasterize
from vlgs.types import ChannelGroup, RasterConfig, Rendered

CHANNELS = [(3, 3), (3, 16), (3, 100), (5,), (3, 3, 3)]
"""In registers; summed by rank; summed by row; one chain; two passes over the tiles."""


def _loss(out: Rendered, images: tuple[int, ...]) -> Tensor:
    rng = torch.Generator().manual_seed(7)
    upstream = [torch.randn(i.shape, generator=rng).to(i) for i in out.images]
    return torch.stack([(upstream[i] * out.images[i]).sum() for i in images]).sum()


def _scene(channels: tuple[int, ...]) -> RenderScene:
    splats = random_splats(300, seed=4, channels=channels).to(torch.float32)
    # Some weights reach the clamp.
    return replace(splats, weights=tuple(w.sqrt().clamp_min(0.01) for w in splats.weights))


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize(
    "kept", ["means", "quats", "weight0", "values0", "values", "weight", "shape"]
)
def test_gradients_do_not_depend_on_which_others_are_wanted(channels: tuple[int, ...], kept: str):
    splats = _scene(channels)
    every = tuple(range(len(channels)))
    out, leaves = render(splats)
    want = dict(
        zip(leaves, torch.autograd.grad(_loss(out, every), list(leaves.values())), strict=True)
    )
    out, leaves = render(splats)
    names = (
        ["means", "quats", "scales"]
        if kept == "shape"
        else [n for n in leaves if n.startswith(kept)]
    )
    for name, leaf in leaves.items():
        leaf.requires_grad_(name in names)
    groups = [ChannelGroup(leaves[f"values{i}"], leaves[f"weight{i}"]) for i in every]
    out = rasterize(
        leaves["means"], leaves["quats"], leaves["scales"], groups, splats.viewmat, splats.K,
        splats.width, splats.height,
    )  # fmt: skip
    got = torch.autograd.grad(_loss(out, every), [leaves[n] for n in names])
    for name, grad in zip(names, got, strict=True):
        assert grad.abs().sum() > 0
        assert torch.equal(grad, want[name]), name


@pytest.mark.parametrize("channels", CHANNELS)
def test_a_picture_that_is_not_used_is_a_picture_with_zero_gradient(channels: tuple[int, ...]):
    splats = _scene(channels)
    for used in itertools.chain(*(itertools.combinations(range(len(channels)), k) for k in (1, 2))):
        results = []
        for zeros in (False, True):
            out, leaves = render(splats)
            loss = _loss(out, used)
            if zeros:
                loss = loss + sum((0 * image).sum() for image in out.images)
            results.append(torch.autograd.grad(loss, list(leaves.values())))
        for name, a, b in zip(leaves, *results, strict=True):
            assert torch.equal(a, b), (used, name)


@pytest.mark.parametrize("channels", CHANNELS)
def test_a_picture_without_gradients_has_the_same_bits(channels: tuple[int, ...]):
    splats = _scene(channels)
    want, _ = render(splats)
    with torch.no_grad():
        got, _ = render(splats)
    for a, b in zip((*want.images, *want.alphas), (*got.images, *got.alphas), strict=True):
        assert torch.equal(a, b)
        assert a.requires_grad
        assert not b.requires_grad
    assert torch.equal(want.visible, got.visible)
    assert torch.equal(want.mean2d, got.mean2d)


def test_the_memory_budget_covers_gradients_where_they_may_be_asked_for():
    splats = _scene((3, 100))
    config = RasterConfig(memory_budget=100_000)  # lists take 6 bytes an entry, slots 464
    with torch.no_grad():
        render(splats, config=config)
    with pytest.raises(ValueError, match="tile lists and gradients must be within memory_budget"):
        render(splats, config=config)
