"""Gradients against finite differences, and how they travel through autograd."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from render_hard_scenes import far_off_axis, needles
from render_scenes import RenderScene, random_splats, render

from vlgs import ChannelGroup, RasterConfig, rasterize

# Cutoffs out of the way: central differences fail on a step.
SMOOTH = RasterConfig(alpha_min=1e-12, transmittance_min=0.0)


def few() -> RenderScene:
    s = random_splats(5, seed=2, channels=(2, 1))
    return replace(
        s, width=6, height=5, K=torch.tensor([[6.0, 0, 2.5], [0, 7, 3], [0, 0, 1]]).double()
    )


def outside_the_clamp() -> RenderScene:
    s = few()
    means = torch.tensor(
        [[5.0, 0.2, 2.0], [-5, 0.1, 2.1], [0.3, 6, 2.2], [-0.2, -6, 2.3], [4, -5, 2.4]]
    ).double()
    return replace(s, means=means, scales=0 * s.scales + 2.5, viewmat=torch.eye(4).double())


@pytest.mark.parametrize("eps2d", [0.3, 0.1])
@pytest.mark.parametrize("scene", [few, outside_the_clamp])
def test_backward_matches_finite_differences(scene: Callable[[], RenderScene], eps2d: float):
    s, config = scene(), replace(SMOOTH, eps2d=eps2d)
    inputs = [s.means, s.quats, s.scales, *(w * 0.9 for w in s.weights), *s.values]

    def images(means, quats, scales, w0, w1, f0, f1):
        groups = [ChannelGroup(f0, w0), ChannelGroup(f1, w1)]
        out = rasterize(means, quats, scales, groups, s.viewmat, s.K, s.width, s.height, config)
        return (*out.images, *out.alphas, out.mean2d)

    assert torch.autograd.gradcheck(images, [t.clone().requires_grad_() for t in inputs])


def test_both_sides_of_the_clamp_are_in_the_hard_scene():
    s = far_off_axis()
    slope = s.means[:16, 0] / s.means[:16, 2]
    inside = (slope * 30 > -(0.45 * 37 + 0.15 * 37)) & (slope * 30 < 0.55 * 37 + 0.15 * 37)
    assert inside.any()
    assert (~inside).any()


def test_mean2d_receives_the_gradient_of_the_pixels():
    s = random_splats(20, seed=1)
    out, leaves = render(s)
    out.mean2d.retain_grad()
    out.images[0].sum().backward()
    assert out.mean2d.grad is not None
    assert out.mean2d.grad.shape == (20, 2)
    assert out.mean2d.grad.any()
    assert leaves["means"].grad is not None


def test_a_graph_may_be_walked_twice():
    out, leaves = render(random_splats(20, seed=1))
    loss = out.images[0].square().sum() + out.alphas[1].sum()
    first = torch.autograd.grad(loss, leaves["means"], retain_graph=True)
    second = torch.autograd.grad(loss, leaves["means"])
    assert torch.equal(first[0], second[0])


def test_unused_pictures_and_frozen_leaves():
    s = random_splats(20, seed=1)
    values = s.values[0].clone().requires_grad_()
    groups = [ChannelGroup(values, s.weights[0]), ChannelGroup(s.values[1], s.weights[1])]
    out = rasterize(s.means, s.quats, s.scales, groups, s.viewmat, s.K, s.width, s.height)
    out.images[0].sum().backward()
    assert values.grad is not None
    assert not out.mean2d.requires_grad


def test_strided_input_is_taken_as_it_is():
    s = random_splats(20, seed=1)
    wide = torch.cat([s.means, s.scales], 1)
    groups = [ChannelGroup(s.values[0].T.contiguous().T, s.weights[0])]
    a = rasterize(wide[:, :3], s.quats, wide[:, 3:], groups, s.viewmat, s.K, s.width, s.height)
    b, _ = render(replace(s, weights=s.weights[:1], values=s.values[:1]))
    assert torch.equal(a.images[0], b.images[0])


def test_needles_keep_their_gradients_in_float32():
    """Thousands of pixels long at 45 degrees: here a determinant by a c - b^2 is negative, and its gradient noise."""
    s = needles()
    rows = slice(0, 16)
    some = replace(
        s, means=s.means[rows], quats=s.quats[rows], scales=s.scales[rows],
        weights=tuple(w[rows] for w in s.weights), values=tuple(v[rows] for v in s.values),
    )  # fmt: skip
    grads = []
    for scene in (some, some.to(torch.float32)):
        out, leaves = render(scene)
        grads.append(torch.autograd.grad(out.images[0].sum(), [leaves["means"], leaves["scales"]]))
    for exact, single in zip(*grads, strict=True):
        assert single.isfinite().all()
        assert (single.double() - exact).norm() < 2e-2 * exact.norm()
