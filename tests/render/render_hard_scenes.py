"""Scenes on which rasterizers are known to fail."""

import math
from dataclasses import replace

import torch
from render_scenes import RenderScene, camera_at_origin, random_splats

ULP = 2.0**-52


def opaque_stack() -> RenderScene:
    s = random_splats(30, seed=5)
    means = torch.zeros(30, 3).double()
    means[:, 2] = torch.linspace(2, 4, 30)
    viewmat, _ = camera_at_origin()
    weights = (torch.ones(30).double(), torch.full((30,), 0.995).double())
    return replace(
        s, means=means, scales=torch.full((30, 3), 0.3).double(), weights=weights, viewmat=viewmat
    )


def needles() -> RenderScene:
    """Long and thin at 45 degrees on the image, up to thousands of pixels."""
    s = random_splats(24, seed=6)
    viewmat, _ = camera_at_origin()
    angle = torch.full((24,), math.pi / 8)
    quats = torch.stack([angle.cos(), 0 * angle, 0 * angle, angle.sin()], 1).double()
    means = torch.randn(24, 3, generator=torch.Generator().manual_seed(1)).double() * 0.4
    means[:, 2] = 2 + 0.05 * torch.arange(24)
    scales = torch.full((24, 3), 1e-3).double()
    scales[:, 0] = torch.logspace(-1, 2, 24)
    return replace(s, means=means, quats=quats, scales=scales, viewmat=viewmat)


def near_plane_and_behind() -> RenderScene:
    s = random_splats(16, seed=7)
    viewmat, _ = camera_at_origin()
    depths = [
        0.01 * (1 - 1e-6),
        0.01,
        0.01 * (1 + 1e-6),
        0.05,
        0.2,
        1,
        100,
        -0.01,
        -1,
        0,
        0.02,
        0.5,
        3,
        4,
        5,
        -3,
    ]
    means = 0.01 * s.means
    means[:, 2] = torch.tensor(depths).double()
    return replace(s, means=means, scales=0.02 * s.scales, viewmat=viewmat)


def far_off_axis() -> RenderScene:
    """Both sides of the field-of-view clamp, on each of its four edges."""
    s = random_splats(32, seed=8)
    viewmat, _ = camera_at_origin()
    slope = torch.linspace(-2.5, 2.5, 16).double()
    means = torch.ones(32, 3).double() * 2
    means[:16, 0], means[:16, 1] = 2 * slope, 0.1
    means[16:, 1], means[16:, 0] = 2 * slope, -0.1
    return replace(s, means=means, scales=s.scales * 6, viewmat=viewmat)


def depth_ties() -> RenderScene:
    s = random_splats(40, seed=9)
    viewmat, _ = camera_at_origin()
    means = s.means.clone()
    means[:, 2] = torch.where(torch.arange(40) % 3 == 0, 2.0, 2.5).double()
    return replace(s, means=means, viewmat=viewmat)


def no_rotation() -> RenderScene:
    s = random_splats(20, seed=10)
    quats = s.quats.clone()
    quats[::3] = 0
    quats[1] *= 1e-20
    quats[2] *= 1e20
    return replace(s, quats=quats)


def weights_at_the_edges() -> RenderScene:
    """At the centre of a pixel the exponent is 0, so that alpha is the weight to the last bit."""
    edges = [
        0,
        1e-7,
        1 / 255 * (1 - ULP),
        1 / 255,
        1 / 255 * (1 + 2 * ULP),
        0.99 * (1 - ULP),
        0.99,
        0.99 * (1 + 2 * ULP),
        1,
    ]
    n = len(edges)
    s = random_splats(n, seed=11)
    viewmat, K = (
        torch.eye(4).double(),
        torch.tensor([[32.0, 0, 0], [0, 32.0, 0], [0, 0, 1]]).double(),
    )
    column = torch.arange(n).double()
    means = torch.stack(
        [(4 * column + 0.5) / 32 * 2, (column + 10.5) / 32 * 2, torch.full((n,), 2.0).double()], 1
    )
    weights = (torch.tensor(edges).double(), torch.tensor(edges).double().flip(0))
    return replace(
        s,
        means=means,
        scales=torch.full((n, 3), 0.05).double(),
        weights=weights,
        viewmat=viewmat,
        K=K,
    )


def pancakes_and_specks() -> RenderScene:
    s = random_splats(30, seed=12)
    scales = s.scales.clone()
    scales[:10, 2] = 0
    scales[10:20] = 1e-12
    scales[20:25] = 50
    return replace(s, scales=scales)


HARD_SCENES = [
    opaque_stack, needles, near_plane_and_behind, far_off_axis, depth_ties, no_rotation,
    weights_at_the_edges, pancakes_and_specks,
]  # fmt: skip
