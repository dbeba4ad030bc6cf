"""Far Gaussians where views look past the sparse points, and nowhere else."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from vlgs.gaussians import GaussiansConfig, attributes_of, initialise
from vlgs.gaussians.background import background, with_background
from vlgs.geometry import camera_center, pose_matrix, scene_extent
from vlgs.types import Camera, Scene, View

WIDTH, HEIGHT = 64, 48
ABOVE, BELOW = (40, 90, 200), (120, 100, 80)


def camera(degrees: float) -> Camera:
    """Level, two units from the middle, which it looks at; the horizon is in the middle of its image."""
    turn = torch.deg2rad(torch.tensor(degrees))
    back = torch.stack([turn.cos(), turn.sin(), torch.tensor(0.0)])
    right = torch.linalg.cross(-back, torch.tensor([0.0, 0.0, 1.0]))
    rotation = torch.stack([right, torch.tensor([0.0, 0.0, -1.0]), -back])
    K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
    return Camera(pose_matrix(rotation, 2 * back), K, WIDTH, HEIGHT)


def image() -> Tensor:
    picture = torch.tensor(ABOVE, dtype=torch.uint8).repeat(HEIGHT, WIDTH, 1)
    picture[HEIGHT // 2 :] = torch.tensor(BELOW, dtype=torch.uint8)
    return picture


def scene(points: Tensor) -> Scene:
    views = tuple(View(f"v{i}", camera(36.0 * i), image) for i in range(10))
    colors = torch.full(points.shape, 128, dtype=torch.uint8)
    return Scene("toy", views, (), "all", points, colors, torch.zeros(0, 8), torch.zeros(0))


def shell(low: float) -> Tensor:
    """Points on a sphere of radius 4 from a height on upwards."""
    points = torch.nn.functional.normalize(
        torch.randn(6000, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    return 4 * points[4 * points[:, 2] > low]


def test_behind_a_closed_room_there_is_the_mean_of_what_views_see():
    cloud = background(scene(shell(-5.0)), 500)
    assert len(cloud.points) == 500
    height = cloud.points[:, 2] / cloud.points.norm(dim=1)
    for wanted, rows in ((ABOVE, (height > 0.1) & (height < 0.3)), (BELOW, height < -0.1)):
        colors = cloud.colors[rows & (height.abs() < 0.3)]
        assert len(colors) > 20
        torch.testing.assert_close(colors, (torch.tensor(wanted) / 255).expand_as(colors))


@pytest.mark.parametrize(("points", "count"), [(shell(9.0), 500), (shell(-5.0), 0)])
def test_without_points_or_when_not_asked_for_there_is_none(points: Tensor, count: int):
    assert len(background(scene(points), count).points) == 0


def test_what_lies_behind_the_points_has_the_colour_that_views_see_there():
    ground = shell(-5.0)
    ground = ground[ground[:, 2] < -0.3]
    toy = scene(ground)
    cloud = background(toy, 500)
    assert len(cloud.points) == 500  # all around: what no view looks into as well
    distance = cloud.points.norm(dim=1)
    height = cloud.points[:, 2] / distance
    extent = scene_extent(torch.stack([v.camera.viewmat for v in toy.train]))
    assert distance[height > 0.2].min() > 9 * extent  # far, where there is nothing
    torch.testing.assert_close(distance[height < -0.4], torch.full_like(distance[height < -0.4], 6))
    sky = cloud.colors[(height > 0.1) & (height < 0.4)]
    torch.testing.assert_close(sky, (torch.tensor(ABOVE) / 255).expand_as(sky))
    # The ground is seen before anything behind it: its colour is nowhere on the sphere.
    assert (cloud.colors - torch.tensor(BELOW) / 255).norm(dim=1).min() > 0.1


def test_no_background_stands_near_a_camera():
    toy = scene(shell(-5.0) / 3)  # behind these points, 2 units from the middle, stand the cameras
    viewmats = torch.stack([v.camera.viewmat for v in toy.train])
    points = background(toy, 500).points
    assert torch.cdist(points, camera_center(viewmats)).min() >= scene_extent(viewmats) / 2
    beside = points[(points[:, 2] / points.norm(dim=1)).abs() < 0.3].norm(dim=1)
    assert beside.min() > 9 * scene_extent(viewmats)  # far instead


@pytest.mark.parametrize(("background_opacity", "starts"), [(None, 0.1), (0.9, 0.9)])
def test_the_first_gaussians_stay_and_the_background_comes_after_them(
    background_opacity: float | None, starts: float
):
    toy = scene(shell(-5.0)[:1])
    config = GaussiansConfig(background=200, background_opacity=background_opacity)
    attributes = attributes_of(config, 3)
    first = initialise(toy, config, attributes)
    both = with_background(first, toy, config, attributes)
    for name, value in both.items():
        assert len(value) == len(first[name]) + 200
        assert torch.equal(value[: len(first[name])], first[name])
    torch.testing.assert_close(both["opacity_logits"][1:].sigmoid(), torch.full((200,), starts))
    angle = both["log_scales"][1:, 0].exp() / both["means"][1:].norm(dim=1)
    assert 0.1 < angle.mean() < 0.5  # neighbours touch: 200 directions are 0.25 radians apart


def test_cameras_that_see_nothing_of_the_sphere_get_none():
    whole = scene(shell(-1.1))
    far_out = torch.tensor([[50.0, 0.0, -1e6], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
    views = tuple(replace(v, camera=replace(v.camera, K=far_out)) for v in whole.train)
    assert len(background(replace(whole, train=views), 500).points) == 0
