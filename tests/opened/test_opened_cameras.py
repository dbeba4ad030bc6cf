"""Orbits, and cameras from the files of others."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from vlgs.data.sparse import SparseCamera, SparseImage, SparseModel, write_transforms
from vlgs.data.sparse.write import write_colmap
from vlgs.geometry import camera_center, pose_matrix
from vlgs.opened import OpenedRun
from vlgs.opened.cameras import cameras_of, look_at, orbit, upright, with_size
from vlgs.types import Camera

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
K = torch.tensor([[50.0, 0.0, 24.0], [0.0, 50.0, 18.0], [0.0, 0.0, 1.0]])


def looking(center: list[float], target: list[float]) -> Camera:
    viewmat = look_at(torch.tensor(center).double(), torch.tensor(target).double(), UP)
    return Camera(viewmat.float(), K, 48, 36)


def test_an_orbit_goes_once_around_what_cameras_look_at():
    # All on one side, and all looking down: their mean up leans by 28 degrees.
    target = [1.0, 2.0, 0.5]
    around = [looking([1 + 4 * math.sin(a), 2 - 4 * math.cos(a), 2.5], target) for a in (-0.6, 0.0, 0.3, 0.6)]  # fmt: skip
    frames = orbit(around, 36)
    assert len({frame.name for frame in frames}) == 36
    viewmats = torch.stack([frame.camera.viewmat for frame in frames]).double()
    centers = camera_center(viewmats)
    torch.testing.assert_close(centers[:, 2], torch.full((36,), 2.5).double(), atol=0.03, rtol=0)
    flat = (centers - torch.tensor(target))[:, :2].norm(dim=1)
    torch.testing.assert_close(flat, torch.full((36,), 4.0).double(), atol=0.03, rtol=0)
    ahead = normalize(torch.tensor(target) - centers, dim=1)
    torch.testing.assert_close(viewmats[:, 2, :3], ahead, atol=5e-3, rtol=0)
    assert (viewmats[:, 0, :3] @ UP).abs().max() < 5e-3, "the horizon is level"
    first = camera_center(around[0].viewmat)
    assert (centers[0] - first).norm() < 0.03, "it begins at the first photograph"


def test_up_is_that_of_level_cameras_and_of_one_alone():
    tilted = [looking([math.cos(a), math.sin(a), 3.0], [0.0, 0.0, 0.0]) for a in (0.0, 0.4, 0.9)]
    torch.testing.assert_close(upright(torch.stack([c.viewmat for c in tilted])), UP, atol=5e-3, rtol=0)  # fmt: skip
    one = tilted[0].viewmat[None]
    torch.testing.assert_close(upright(one), -one[0, 1, :3].double(), atol=1e-5, rtol=0)


def test_another_size_keeps_the_height_of_what_is_seen():
    camera = with_size(looking([3.0, 0.0, 0.0], [0.0, 0.0, 0.0]), 200, 72)
    assert (camera.width, camera.height) == (200, 72)
    torch.testing.assert_close(camera.K, torch.tensor([[100.0, 0, 100], [0, 100, 36], [0, 0, 1]]))
    with pytest.raises(ValueError, match="width must be 1 to 16384"):
        with_size(camera, 0, 5)


def nerfstudio_path(**changes: Any) -> dict[str, Any]:
    """Two cameras, one at (0, -3, 1) that looks along y, the other half a turn further."""
    # OpenGL: the columns are right, up, back, place.
    poses = [[1, 0, 0, 0, 0, 0, -1, -3, 0, 1, 0, 1, 0, 0, 0, 1], [-1, 0, 0, 0, 0, 0, 1, 3, 0, 1, 0, 1, 0, 0, 0, 1]]  # fmt: skip
    path = [{"camera_to_world": pose, "fov": 90.0, "aspect": 2.0} for pose in poses]
    said = {"render_width": 80, "render_height": 40, "fps": 12, "camera_type": "perspective"}
    return {"camera_path": path, **said, **changes}


def test_a_camera_path_of_nerfstudio(tmp_path: Path, opened: OpenedRun):
    file = tmp_path / "path.json"
    file.write_text(json.dumps(nerfstudio_path()))
    path = cameras_of(opened, str(file))
    assert (len(path.frames), path.fps) == (2, 12)
    first = path.frames[0].camera
    assert (first.width, first.height) == (80, 40)
    torch.testing.assert_close(first.K, torch.tensor([[20.0, 0, 40], [0, 20, 20], [0, 0, 1]]))
    torch.testing.assert_close(camera_center(first.viewmat), torch.tensor([0.0, -3, 1]))
    torch.testing.assert_close(first.viewmat[2, :3], torch.tensor([0.0, 1, 0]))
    torch.testing.assert_close(first.viewmat[1, :3], torch.tensor([0.0, 0, -1]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_path": []}, "camera_path must be a list of 1 to"),
        ({"camera_path": [3]}, "camera 0 must be a mapping"),
        ({"camera_path": [{"fov": 50, "camera_to_world": [0] * 16}]}, "a rotation and a place"),
        ({"camera_path": [{"fov": 50, "camera_to_world": "x"}]}, "a rotation and a place"),
        ({"camera_path": [{"fov": 180, "camera_to_world": [1] * 16}]}, "fov must be 0.1 to 179"),
        ({"render_width": 10**6}, "render_width must be 1 to 16384"),
        ({"fps": 0}, "fps must be"),
        ({"camera_type": "fisheye"}, "camera_type must be perspective"),
    ],
)
def test_a_path_at_fault_is_one_error(
    tmp_path: Path, opened: OpenedRun, changes: dict[str, Any], message: str
):
    file = tmp_path / "path.json"
    file.write_text(json.dumps(nerfstudio_path(**changes)))
    with pytest.raises(ValueError, match=message):
        cameras_of(opened, str(file))


def test_cameras_of_colmap_and_of_transforms(tmp_path: Path, opened: OpenedRun):

    pose = pose_matrix(torch.eye(3, dtype=torch.float64), torch.tensor([1.0, 2.0, 3.0]).double())
    camera = SparseCamera(1, "PINHOLE", 48, 36, (40.0, 41.0, 23.0, 19.0))
    image = SparseImage(1, 1, "b.png", (1.0, 0.0, 0.0, 0.0), tuple(pose[:3, 3].tolist()), -1)
    images = (image, replace(image, image_id=2, name="a.png"))
    points, colors = np.zeros((1, 3)), np.zeros((1, 3), np.uint8)
    model = SparseModel(tmp_path, "made", (camera,), images, np.array([1]), points, colors)
    write_colmap(tmp_path / "model", model)
    write_transforms(tmp_path / "transforms.json", model)
    for source, names in (("model", ["a", "b"]), ("transforms.json", ["b", "a"])):
        frames = cameras_of(opened, str(tmp_path / source)).frames
        assert [frame.name for frame in frames] == names
        got = frames[0].camera
        torch.testing.assert_close(camera_center(got.viewmat), torch.tensor([1.0, 2.0, 3.0]))
        assert got.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == [40.0, 41.0, 23.0, 19.0]
        assert (got.width, got.height) == (48, 36)


def test_frames_of_a_transforms_json_come_in_its_order(tmp_path: Path, opened: OpenedRun):
    """A path that is to be a video; by name 10 would come after 1."""
    poses = [[[1, 0, 0, i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] for i in range(12)]
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose} for i, pose in enumerate(poses)]
    (tmp_path / "path.json").write_text(
        json.dumps({"fl_x": 20, "w": 24, "h": 18, "frames": frames})
    )
    found = cameras_of(opened, str(tmp_path / "path.json")).frames
    assert [frame.name for frame in found] == [str(i) for i in range(12)]


def test_images_of_one_stem_keep_apart(opened: OpenedRun, tmp_path: Path):
    lens = SparseCamera(1, "PINHOLE", 48, 36, (40.0, 41.0, 23.0, 19.0))
    names = ("left/1.jpg", "right/1.jpg", "right/2.jpg")
    images = tuple(
        SparseImage(i + 1, 1, name, (1.0, 0, 0, 0), (-1.0, -2.0, -3.0), observations=-1)
        for i, name in enumerate(names)
    )
    nothing = np.zeros((0, 3))
    model = SparseModel(tmp_path, "made", (lens,), images, np.zeros(0, int), nothing, nothing.astype(np.uint8))  # fmt: skip
    write_transforms(tmp_path / "transforms.json", model)
    frames = cameras_of(opened, str(tmp_path / "transforms.json")).frames
    assert len({frame.name for frame in frames}) == 3
    assert frames[-1].name == "2"


@pytest.mark.parametrize("which", ["", " "])
def test_no_name_is_no_camera(opened: OpenedRun, which: str):
    with pytest.raises(ValueError, match="cameras: must be train, test, orbit"):
        cameras_of(opened, which)


def test_cameras_of_the_run_by_name_and_what_is_none(opened: OpenedRun):
    name = opened.cameras("train")[2].name
    assert [one.name for one in cameras_of(opened, name).frames] == [name]
    assert list(cameras_of(opened, "test").frames) == list(opened.cameras("test"))
    assert len(cameras_of(opened, "orbit", 7).frames) == 7
    with pytest.raises(
        ValueError, match="must be train, test, orbit, a photograph's name or a file"
    ):
        cameras_of(opened, "nowhere")
    with pytest.raises(ValueError, match="frames must be 1 to"):
        cameras_of(opened, "orbit", 0)
