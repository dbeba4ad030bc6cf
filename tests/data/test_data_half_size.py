"""Training views at half their width and height."""

from dataclasses import replace

import pytest
import torch

from vlgs.data.half_size import half_size
from vlgs.types import Camera, Scene, View

K = torch.tensor([[10.0, 0, 3.5], [0, 12.0, 2.0], [0, 0, 1]])
PIXELS = torch.arange(4 * 6 * 3, dtype=torch.uint8).view(4, 6, 3) * 3


def scene_of(scene: Scene, view: View) -> Scene:
    return replace(scene, train=(view,))


@pytest.fixture
def view() -> View:
    return View("a", Camera(torch.eye(4), K, 6, 4), lambda: PIXELS)


def test_a_pixel_is_the_mean_over_its_area(tiny_scene: Scene, view: View):
    small = half_size(scene_of(tiny_scene, view)).train[0]
    means = PIXELS.float().view(2, 2, 3, 2, 3).mean(dim=(1, 3))
    assert (small.read_image().float() - means).abs().max() <= 0.5
    assert (small.camera.width, small.camera.height) == (3, 2)
    assert torch.equal(small.camera.K, K * torch.tensor([[0.5], [0.5], [1.0]]))
    assert torch.equal(small.camera.viewmat, view.camera.viewmat)


def test_masks_are_those_in_the_middle_and_borders_do_not_count(tiny_scene: Scene, view: View):
    masks = torch.arange(5 * 7 * 2, dtype=torch.int32).view(5, 7, 2)
    valid = torch.ones(5, 7, dtype=torch.bool)
    valid[0, 0] = False
    odd = replace(
        view,
        camera=Camera(torch.eye(4), K, 7, 5),
        read_image=lambda: torch.zeros(5, 7, 3, dtype=torch.uint8),
        read_masks=lambda: masks,
        read_valid=lambda: valid,
    )
    small = half_size(scene_of(tiny_scene, odd)).train[0]
    assert (small.camera.width, small.camera.height) == (4, 3)
    assert small.read_image().shape == (3, 4, 3)
    assert small.read_masks is not None
    assert small.read_valid is not None
    assert torch.equal(small.read_masks(), masks[[0, 2, 4]][:, [0, 2, 4, 6]])
    assert small.read_valid().tolist() == [[False, True, True, True], [True] * 4, [True] * 4]


def test_all_else_is_the_scene_s(tiny_scene: Scene):
    small = half_size(tiny_scene)
    assert small.test == tiny_scene.test
    assert small.points is tiny_scene.points
    assert [view.name for view in small.train] == [view.name for view in tiny_scene.train]
    one = replace(tiny_scene.train[0], camera=Camera(torch.eye(4), K, 1, 1))
    assert half_size(scene_of(tiny_scene, one)).train[0].camera.width == 1
