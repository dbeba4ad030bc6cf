"""Rays of pixels, and what is known of them in closed form."""

import math

import pytest
import torch

from vlgs.fields.rays import Spacing, importance, pixel_rays, ray_weights, spread
from vlgs.types import Camera

R = torch.rand(3, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def test_weights_of_a_constant_density_are_those_of_the_closed_form():
    """exp(-d t_i) - exp(-d t_(i+1)): what an exponential law gives each interval."""
    density, lengths = 1.7, R + 0.01
    ends = lengths.cumsum(1)
    starts = ends - lengths
    want = torch.exp(-density * starts) - torch.exp(-density * ends)
    got = ray_weights(torch.full_like(lengths, density), lengths)
    torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(got.sum(1), 1 - torch.exp(-density * ends[:, -1]))


def test_an_interval_without_end_takes_all_that_is_left():
    lengths = R.clone()
    lengths[:, -1] = 1e10
    torch.testing.assert_close(ray_weights(R, lengths).sum(1), torch.ones(3, dtype=torch.float64))


def test_spread_is_that_of_the_double_sum():
    edges = torch.cat([torch.zeros(3, 1), R], dim=1).cumsum(1).double()
    weights = R.flip(0)
    middles, lengths = (edges[:, 1:] + edges[:, :-1]) / 2, edges.diff(dim=1)
    pairs = weights[:, :, None] * weights[:, None] * (middles[:, :, None] - middles[:, None]).abs()
    want = pairs.sum((1, 2)) + (weights.square() * lengths).sum(1) / 3
    torch.testing.assert_close(spread(edges, weights), want.mean())


def test_draws_go_where_the_weight_is():
    edges = torch.tensor([[0.0, 1.0, 2.0, 4.0]])
    draws = torch.tensor([[0.0, 0.125, 0.25, 0.625, 1.0]])
    got = importance(edges, torch.tensor([[1.0, 0.0, 3.0]]), draws)
    torch.testing.assert_close(got, torch.tensor([[0.0, 0.5, 2.0, 3.0, 4.0]]))


def test_rays_go_through_the_middles_of_pixels():
    turned = torch.eye(4)
    turned[:3, :3] = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    turned[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    K = torch.tensor([[40.0, 0, 20.3], [0, 42, 15.1], [0, 0, 1]])
    camera, pixels = Camera(turned, K, 40, 30), torch.tensor([0, 39, 40, 1199])
    rays = pixel_rays(camera, pixels)
    assert torch.allclose(rays.directions.norm(dim=1), torch.ones(4))
    seen = rays.points(torch.full((4, 1), 2.5))[:, 0] @ turned[:3, :3].T + turned[:3, 3]
    projected = seen @ K.T
    want = torch.tensor([[0.5, 0.5], [39.5, 0.5], [0.5, 1.5], [39.5, 29.5]])
    torch.testing.assert_close(projected[:, :2] / projected[:, 2:], want)


def test_steps_rise_from_near_to_the_horizon():
    spacing = Spacing(0.2, 3.0)
    reached = spacing(torch.linspace(0, 1, 50))
    assert (reached.diff() > 0).all()
    assert math.isclose(reached[0].item(), 0.2, rel_tol=1e-6)
    assert math.isclose(reached[-1].item(), 3000, rel_tol=1e-3)
    with pytest.raises(ValueError, match=r"near must be above 0 and below far \(1.0\), got 2.0"):
        Spacing(2.0, 1.0)
