"""Places to look from: those of photographs, parts of a picture, and what is up."""

import math

import torch
from torch import Tensor

from vlgs.fields import Field
from vlgs.geometry import camera_center, quat_to_rotmat, resize_camera
from vlgs.types import Camera
from vlgs.view.eye import Eye, eye_of, part, surroundings
from vlgs.view.shown import Shown


def project(camera: Camera, point: Tensor) -> Tensor:
    seen = camera.K @ (camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3])
    return seen[:2] / seen[2]


def test_an_eye_is_a_camera_in_opencv_axes():
    # It stands at x = 1 and looks along the world's y with z up: its axes are x, -z, y.
    half = math.sqrt(0.5)
    eye = Eye((1.0, 0.0, 0.0), (half, -half, 0.0, 0.0), math.radians(90), 40, 20)
    camera = eye.camera()
    assert (camera.width, camera.height) == (40, 20)
    assert torch.allclose(project(camera, torch.tensor([1.0, 5.0, 0.0])), torch.tensor([20.0, 10]))
    # Half the field of view is 45 degrees: 1 up at distance 1 is the upper edge.
    assert torch.allclose(project(camera, torch.tensor([1.0, 1, 1])), torch.tensor([20.0, 0.0]))
    assert torch.allclose(project(camera, torch.tensor([2.0, 1, 0])), torch.tensor([30.0, 10.0]))
    assert torch.allclose(
        project(eye.camera(20, 10), torch.tensor([2.0, 1, 0])), torch.tensor([15.0, 5.0])
    )


def test_all_of_a_photograph_is_seen_from_its_camera(shown: Shown):
    camera = shown.run.cameras()[2].camera
    for width, height in ((300, 100), (100, 300), (48, 36)):
        eye = eye_of(camera, width, height)
        made = eye.camera()
        assert torch.allclose(made.viewmat, camera.viewmat, atol=1e-5)
        ray = torch.linalg.inv(camera.K) @ torch.tensor([0.0, 0.0, 1.0])
        corner = camera.viewmat[:3, :3].mT @ (ray - camera.viewmat[:3, 3])
        x, y = project(made, corner).tolist()
        assert min(x, y) > -1e-2
        assert min(abs(x), abs(y)) < 1e-2  # and no more than that is seen in one direction


def test_a_part_of_a_camera_sees_the_same_pixels(shown: Shown):
    camera = shown.run.held_out()[0].camera
    whole = colors(shown.run.field, camera)
    # The rasterizer keeps slopes within bounds that depend on the size of an image (RasterConfig.fov_margin).
    middle = colors(shown.run.field, part(camera, 8, 40, 4, 30))
    assert (middle - whole[4:30, 8:40]).abs().mean() < 1e-3


def colors(field: Field, camera: Camera) -> Tensor:
    color = field.render(camera, frozenset({"color"})).color
    assert color is not None
    return color


def test_up_and_focus_are_those_of_a_ring_of_cameras():
    cameras, focus = [], torch.tensor([1.0, 2.0, 0.5])
    for index in range(6):
        angle = index * math.pi / 3
        center = focus + torch.tensor([3 * math.cos(angle), 3 * math.sin(angle), 1.5])
        ahead = torch.nn.functional.normalize(focus - center, dim=0)
        right = torch.nn.functional.normalize(ahead.cross(torch.tensor([0.0, 0, 1]), dim=0), dim=0)
        rotation = torch.stack([right, ahead.cross(right, dim=0), ahead])
        viewmat = torch.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ center
        cameras.append(Camera(viewmat, torch.eye(3), 4, 3))
    around = surroundings(cameras)
    assert torch.allclose(torch.tensor(around.up), torch.tensor([0.0, 0.0, 1.0]), atol=1e-5)
    # 2e-4 off: a weak pull decides where axes are parallel.
    assert torch.allclose(around.focus, focus, atol=1e-3)
    for camera in cameras:
        assert torch.allclose(torch.tensor(around.look_at(camera)), focus, atol=1e-3)
        assert torch.allclose(
            torch.tensor(around.up_of(camera)), torch.tensor([0.0, 0, 1]), atol=1e-5
        )


def test_a_rolled_camera_keeps_its_roll():
    roll = torch.tensor([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    level = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks along y, z is up
    viewmat = torch.eye(4)
    viewmat[:3, :3] = level
    around = surroundings([Camera(viewmat, torch.eye(3), 4, 3)])
    rolled = viewmat.clone()
    rolled[:3, :3] = roll @ level
    up = torch.tensor(around.up_of(Camera(rolled, torch.eye(3), 4, 3)))
    assert torch.allclose(rolled[0, :3] @ up, torch.tensor(0.0), atol=1e-6)
    assert torch.allclose(-rolled[1, :3] @ up, torch.tensor(1.0), atol=1e-6)


def test_an_eye_has_the_place_of_its_camera(shown: Shown):
    camera = resize_camera(shown.run.cameras()[0].camera, 96, 72)
    eye = eye_of(camera, 96, 72)
    assert torch.allclose(torch.tensor(eye.position), camera_center(camera.viewmat), atol=1e-5)
    rotation = quat_to_rotmat(torch.tensor(eye.wxyz))
    assert torch.allclose(rotation, camera.viewmat[:3, :3].mT, atol=1e-5)


def test_up_is_up_in_a_scene(shown: Shown):
    around = surroundings([one.camera for one in shown.run.cameras()])
    assert around.up[2] > 0.9  # the cameras look down at a table
