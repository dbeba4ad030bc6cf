import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from vlgs.gaussians import GaussiansConfig, activate, attributes_of, initialise
from vlgs.gaussians.neighbors import mean_squared_distance
from vlgs.geometry import pose_matrix
from vlgs.types import Camera, Scene, View

GARDEN = Path(__file__).parents[2] / "../shared/data/gsplat_test_garden/test_garden.npz"


def initialise_for(where: Scene, config: GaussiansConfig, width: int, seed: int = 0):
    return initialise(where, config, attributes_of(config, width), seed)


def camera_at(center: Tensor, forward: Tensor) -> Camera:
    """A 90-degree camera that looks along `forward`, which is not vertical."""
    z = forward / forward.norm()
    x = torch.linalg.cross(z, torch.tensor([0.0, 0.0, 1.0]))
    x = x / x.norm()
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    K = torch.tensor([[50.0, 0.0, 50.0], [0.0, 50.0, 40.0], [0.0, 0.0, 1.0]])
    return Camera(pose_matrix(rotation, center), K, 100, 80)


def no_image() -> Tensor:
    raise AssertionError("initialise must not read images")


def scene(
    points: Tensor, colors: Tensor | None = None, cameras: list[Camera] | None = None
) -> Scene:
    if cameras is None:
        cameras = [camera_at(torch.tensor([0.0, -3.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))]
    if colors is None:
        colors = torch.full(points.shape, 128, dtype=torch.uint8)
    views = tuple(View(f"v{i}", camera, no_image) for i, camera in enumerate(cameras))
    empty = torch.zeros(0, 8)
    return Scene("toy", views, (), "all", points, colors, empty, torch.zeros(0))


def brute_force(points: Tensor, k: int) -> Tensor:
    squared = (points[:, None].double() - points[None].double()).square().sum(-1)
    squared.fill_diagonal_(math.inf)
    return squared.topk(min(k, len(points) - 1), largest=False).values.mean(1).to(points.dtype)


CLOUDS: dict[str, Callable[[int, torch.Generator], Tensor]] = {
    "uniform": lambda n, g: torch.rand(n, 3, generator=g),
    "line": lambda n, g: torch.rand(n, 1, generator=g) * torch.tensor([1.0, 0.0, 0.0]),
    "clusters": lambda n, g: (
        torch.randint(4, (n, 1), generator=g) * 100.0 + torch.randn(n, 3, generator=g)
    ),
    "outliers": lambda n, g: torch.randn(n, 3, generator=g).pow(7),
    "duplicates": lambda n, g: torch.randint(3, (n, 3), generator=g).float(),
}


@pytest.mark.parametrize("kind", CLOUDS)
@given(n=st.integers(2, 700), k=st.integers(1, 4), seed=st.integers(0, 2**31))
@settings(max_examples=12, deadline=None)
def test_neighbours_match_brute_force(kind: str, n: int, k: int, seed: int):
    points = CLOUDS[kind](n, torch.Generator().manual_seed(seed))
    torch.testing.assert_close(
        mean_squared_distance(points, k), brute_force(points, k), rtol=1e-5, atol=0
    )


@pytest.mark.parametrize("source", ["procedural", "garden"])
def test_neighbours_of_a_scenes_points(source: str, tiny_scene: Scene):
    if source == "procedural":
        points = tiny_scene.points
    elif GARDEN.exists():
        points = torch.from_numpy(np.load(GARDEN)["means3d"][::60].copy()).float()
    else:
        pytest.skip("real points not at hand")
    torch.testing.assert_close(
        mean_squared_distance(points), brute_force(points, 3), rtol=1e-5, atol=0
    )


def test_hand_worked_start():
    points = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.2]])
    colors = torch.tensor([[255, 0, 51]], dtype=torch.uint8).repeat(4, 1)
    params = initialise_for(scene(points, colors), GaussiansConfig(sh_degree=2), 5)
    assert list(params) == list(attributes_of(GaussiansConfig(), 5))
    assert {k: tuple(v.shape[1:]) for k, v in params.items()} == {
        "means": (3,), "quats": (4,), "log_scales": (3,), "sh0": (3,), "shN": (8, 3),
        "opacity_logits": (), "indicator_logits": (), "features": (5,),
    }  # fmt: skip
    torch.testing.assert_close(params["means"], points)
    torch.testing.assert_close(params["log_scales"][0].exp(), torch.full((3,), 0.03**0.5))
    gaussians = activate(params)
    torch.testing.assert_close(gaussians.opacities, torch.full((4,), 0.1))
    torch.testing.assert_close(gaussians.indicators, torch.full((4,), 0.1))
    torch.testing.assert_close(
        0.5 + 0.28209479 * gaussians.sh0[0], torch.tensor([1.0, 0.0, 0.2]), rtol=0, atol=1e-6
    )
    assert gaussians.features.eq(0).all()
    assert gaussians.shN.eq(0).all()
    assert gaussians.quats.eq(torch.tensor([1.0, 0.0, 0.0, 0.0])).all()


def test_scales_are_clamped_on_both_sides():
    near = torch.tensor([[0.0, 0.0, 0.0], [1e-6, 0.0, 0.0], [0.0, 1e-6, 0.0], [0.0, 0.0, 1e-6]])
    lone = torch.tensor([[0.0, 900.0, 0.0]])
    params = initialise_for(scene(torch.cat([near, lone])), GaussiansConfig(max_init_angle=0.05), 3)
    scales = params["log_scales"].exp()
    torch.testing.assert_close(scales[:4], torch.full((4, 3), 1e-7**0.5))
    torch.testing.assert_close(scales[4], torch.full((3,), 0.05 * 903.0))


def test_unusable_points_are_left_out():
    good = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    bad = torch.tensor(
        [
            [math.nan, 0.0, 0.0],
            [0.0, math.inf, 0.0],
            [1e30, 0.0, 0.0],
            [0.0, -3.0, 0.009],  # on the camera
            [1.0, 0.0, 0.0],  # seen before
        ]
    )
    params = initialise_for(scene(torch.cat([good, bad])), GaussiansConfig(), 3)
    torch.testing.assert_close(params["means"], good)
    assert all(value.isfinite().all() for value in params.values())


def test_one_point_is_enough():
    params = initialise_for(scene(torch.zeros(1, 3)), GaussiansConfig(), 3)
    torch.testing.assert_close(params["log_scales"].exp(), torch.full((1, 3), 0.3))


def test_too_many_points_are_thinned_by_seed():
    points = torch.rand(300, 3)
    config = GaussiansConfig(max_count=100)
    first, again, other = (initialise_for(scene(points), config, 3, s)["means"] for s in (0, 0, 1))
    assert len(first) == 100
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert all((points == mean).all(1).any() for mean in first)


def test_without_points_random_ones_fill_what_the_cameras_share():
    angles = torch.arange(8) * (2 * math.pi / 8)
    around = torch.stack([angles.cos(), angles.sin(), torch.full_like(angles, 0.3)], dim=1) * 4
    middle = torch.tensor([50.0, -20.0, 7.0])
    cameras = [camera_at(middle + offset, -offset) for offset in around]
    before = torch.get_rng_state()
    config = GaussiansConfig(init_points=2000)
    params = initialise_for(scene(torch.zeros(0, 3), cameras=cameras), config, 3)
    again = initialise_for(scene(torch.zeros(0, 3), cameras=cameras), config, 3)
    assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(params["means"], again["means"])
    assert params["means"].shape == (2000, 3)
    assert (params["means"] - middle).norm(dim=1).median() < 3.0


def test_bad_input():
    with pytest.raises(ValueError, match="must have training views"):
        initialise_for(scene(torch.zeros(1, 3), cameras=[]), GaussiansConfig(), 3)
    with pytest.raises(ValueError, match="width of the language code must be at least 1"):
        initialise_for(scene(torch.zeros(1, 3)), GaussiansConfig(), 0)
    with pytest.raises(ValueError, match="parameters must have"):
        activate({"means": torch.zeros(1, 3)})
