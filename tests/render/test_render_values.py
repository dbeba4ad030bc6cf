"""Values worked by hand, symmetries, and what groups may and may not share."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scenes import camera_at_origin, random_splats, render, render_with_gradients

from vlgs import ChannelGroup, RasterConfig, rasterize


def flat_splats(
    depths: list[float], weights: list[float], values: list[list[float]], x: float = 0.0
):
    """Round Gaussians of 0.1 on the optical axis of a camera with focal length 20, seen by the middle one of 3x3 pixels."""
    n = len(depths)

    def tensor(rows: list) -> torch.Tensor:
        return torch.tensor(rows, dtype=torch.float64)

    means = tensor([[x, 0, z] for z in depths])
    quats = tensor([[1, 0, 0, 0]]).expand(n, 4)
    group = ChannelGroup(tensor(values), tensor(weights))
    K = tensor([[20, 0, 1.5], [0, 20, 1.5], [0, 0, 1]])
    scales = tensor([[0.1] * 3] * n)
    return means, quats, scales, [group], torch.eye(4).double(), K, 3, 3


def test_one_over_another():
    out = rasterize(*flat_splats([4.0, 2.0], [0.5, 0.25], [[1.0, 0.0], [0.0, 1.0]]))
    # In front: 0.25 of (0, 1); behind: 0.5 * (1 - 0.25) of (1, 0).
    torch.testing.assert_close(out.images[0][1, 1], torch.tensor([0.375, 0.25]).double())
    torch.testing.assert_close(out.alphas[0][1, 1], torch.tensor(0.625).double())


def test_falloff_of_one_pixel():
    out = rasterize(*flat_splats([2.0], [0.8], [[1.0]]))
    # 0.1 at depth 2 with focal length 20 is 1 pixel, blurred by 0.3 pixel^2; off axis the Jacobian adds nothing at x = 0.
    assert out.images[0][1, 2, 0].item() == pytest.approx(0.8 * math.exp(-0.5 / 1.3), rel=1e-12)
    assert out.images[0][0, 0, 0].item() == pytest.approx(0.8 * math.exp(-0.5 * 2 / 1.3), rel=1e-12)
    assert out.mean2d.tolist() == [[1.5, 1.5]]


def test_a_contribution_below_the_cutoff_is_not_there():
    out = rasterize(*flat_splats([2.0], [1 / 256], [[1.0]]))
    assert not out.images[0].any()
    assert out.visible.tolist() == [False]


def test_stop_decides_about_the_contribution_that_crosses():
    splats = flat_splats([1.0, 2.0, 3.0], [1.0, 1.0, 1.0], [[1.0], [1.0], [1.0]])
    after = rasterize(*splats, config=RasterConfig(transmittance_min=5e-3))
    before = rasterize(*splats, config=RasterConfig(transmittance_min=5e-3, stop="before"))
    assert after.images[0][1, 1, 0].item() == pytest.approx(1 - 1e-4)
    assert before.images[0][1, 1, 0].item() == pytest.approx(0.99)


def test_what_lies_behind_an_opaque_stack_has_no_gradient():
    splats = random_splats(30, seed=0, channels=(3,))
    viewmat, K = camera_at_origin()
    K[:2, 2] = torch.tensor([18.5, 14.5])
    means = torch.zeros(30, 3).double()
    means[:, 2] = torch.linspace(1, 3, 30)
    splats = replace(
        splats, means=means, scales=torch.full((30, 3), 5.0).double(), viewmat=viewmat, K=K,
        weights=(torch.ones(30).double(),),
    )  # fmt: skip
    _, grads = render_with_gradients(splats)
    assert grads["values0"][:2].abs().min() > 0
    for name in ("means", "quats", "scales", "weight0", "values0"):
        assert not grads[name][4:].any(), name


def test_equal_weights_in_two_tensors_give_equal_bits():
    splats = random_splats(150, seed=1, channels=(3, 3)).to(torch.float32)
    o, f = splats.weights[0], splats.values[0]
    out, grads = render_with_gradients(
        replace(splats, weights=(o, o.clone()), values=(f, f.clone()))
    )
    assert torch.equal(out.images[0], out.images[1])
    assert torch.equal(out.alphas[0], out.alphas[1])
    shared, _ = render(replace(splats, weights=(o, o), values=(f, f.clone())))
    torch.testing.assert_close(shared.images[0], out.images[0], rtol=1e-6, atol=1e-6)
    assert grads["values0"].shape == f.shape


@pytest.mark.parametrize("channels", [(3, 3), (3, 16), (4, 4, 4)])
def test_groups_do_not_see_each_other(channels: tuple[int, ...]):
    """Another indicator: colour and its gradients keep every bit, with and without a longer list of tiles."""
    splats = random_splats(150, seed=2, channels=channels).to(torch.float32)
    o, *rest = splats.weights
    changed = replace(splats, weights=(o, *((w * 0.3 + 0.7).flip(0) for w in rest)))
    images, grads = [], []
    for scene in (splats, changed):
        out, leaves = render(scene)
        names = ["means", "quats", "scales", "weight0", "values0"]
        grads.append(torch.autograd.grad(out.images[0].square().sum(), [leaves[n] for n in names]))
        images.append(out.images[0])
    assert torch.equal(*images)
    for a, b in zip(*grads, strict=True):
        assert torch.equal(a, b)


def test_sign_and_length_of_a_quaternion_do_not_matter():
    splats = random_splats(60, seed=3).to(torch.float32)
    base, _ = render(splats)
    negative, _ = render(replace(splats, quats=-splats.quats))
    double, _ = render(replace(splats, quats=2 * splats.quats))
    assert torch.equal(base.images[0], negative.images[0])
    torch.testing.assert_close(base.images[0], double.images[0], rtol=1e-6, atol=1e-6)
    _, grads = render_with_gradients(splats)
    along = (grads["quats"] * splats.quats).sum(1).abs() / (grads["quats"].norm(dim=1) + 1e-9)
    assert along.max() < 1e-5


def test_zero_quaternions_change_nothing():
    splats = random_splats(60, seed=4).to(torch.float32)
    hidden = torch.arange(60) % 4 == 1
    with_hidden, grads = render_with_gradients(
        replace(splats, quats=torch.where(hidden[:, None], 0.0, splats.quats))
    )
    kept = [
        t[~hidden]
        for t in (splats.means, splats.quats, splats.scales, *splats.weights, *splats.values)
    ]
    without, _ = render(
        replace(
            splats,
            means=kept[0],
            quats=kept[1],
            scales=kept[2],
            weights=tuple(kept[3:5]),
            values=tuple(kept[5:]),
        )
    )
    assert torch.equal(with_hidden.images[0], without.images[0])
    assert not with_hidden.visible[hidden].any()
    for name in ("means", "quats", "scales", "weight0", "values1"):
        assert not grads[name][hidden].any()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), x=st.integers(0, 20), y=st.integers(0, 15))
def test_a_crop_is_a_part_of_the_whole(seed: int, x: int, y: int):
    """With the clamp of the Jacobian out of the way, an off-centre principal point is all that a crop changes."""
    config = RasterConfig(fov_margin=1e6)
    splats = random_splats(40, seed)
    whole, _ = render(splats, config=config)
    K = splats.K.clone()
    K[:2, 2] -= torch.tensor([x, y])
    crop, _ = render(replace(splats, K=K, width=13, height=11), config=config)
    part = whole.images[0][y : y + 11, x : x + 13]
    torch.testing.assert_close(crop.images[0], part, rtol=0, atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_turning_scene_and_camera_together(seed: int):
    splats = random_splats(40, seed)
    rng = torch.Generator().manual_seed(seed)
    q = torch.randn(4, generator=rng).double()
    q = q / q.norm()
    w, v = q[0], q[1:]
    cross = torch.linalg.cross(torch.eye(3).double(), v.expand(3, 3)).T
    rotation = torch.eye(3).double() + 2 * (-w * cross + cross @ cross)
    rotation = rotation if torch.linalg.det(rotation) > 0 else -rotation
    shift = torch.randn(3, generator=rng).double()
    # Hamilton product q * p turns p's rotation by q's.
    pw, pv = splats.quats[:, :1], splats.quats[:, 1:]
    turned_w = w * pw - (v * pv).sum(1, keepdim=True)
    turned_v = w * pv + pw * v + torch.linalg.cross(v.expand_as(pv), pv)
    viewmat = splats.viewmat.clone()
    viewmat[:3, :3] = splats.viewmat[:3, :3] @ rotation.T
    viewmat[:3, 3] = splats.viewmat[:3, 3] - viewmat[:3, :3] @ shift
    turned = replace(
        splats,
        means=splats.means @ rotation.T + shift,
        quats=torch.cat([turned_w, turned_v], 1),
        viewmat=viewmat,
    )
    a, _ = render(splats)
    b, _ = render(turned)
    torch.testing.assert_close(a.images[0], b.images[0], rtol=0, atol=1e-9)


def test_equal_depths_are_drawn_in_the_order_of_the_rows():
    out = rasterize(*flat_splats([2.0, 2.0], [1.0, 1.0], [[1.0], [0.0]]))
    assert out.images[0][1, 1, 0].item() == pytest.approx(0.99)


@pytest.mark.parametrize("n", [0, 1, 7])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_nothing_to_see_is_exactly_zero(n: int, backend: str):
    splats = random_splats(n, seed=5)
    behind = replace(
        splats, viewmat=torch.eye(4).double(), means=splats.means * 0 - torch.tensor([0, 0, 5.0])
    )
    faint = replace(splats, weights=tuple(w * 0 + 1 / 300 for w in splats.weights))
    for scene in (behind, faint):
        out, grads = render_with_gradients(scene, backend)
        assert not torch.stack(out.alphas).any()
        assert not torch.stack(out.images).any()
        assert not out.visible.any()
        for name, grad in grads.items():
            assert not grad.any(), name


def test_a_group_below_the_cutoff_leaves_the_other_alone():
    splats = random_splats(30, seed=6)
    o, f = splats.weights
    out, grads = render_with_gradients(replace(splats, weights=(o, 0 * f)))
    assert not out.images[1].any()
    assert out.images[0].any()
    assert not grads["values1"].any()
