"""A run of a scene in the coordinates of a map knows where its own begin."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from colmap_scenes import surveyed

from vlgs.data.colmap import load_scene
from vlgs.files import write_atomically
from vlgs.opened import OpenedRun
from vlgs.opened.cameras import cameras_of
from vlgs.opened.files import read_scene, write_scene
from vlgs.runs import RunFolder
from vlgs.training.checkpoint import decode, encode
from vlgs.types import Scene

_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return load_scene(str(surveyed(tmp_path / "far")))


@pytest.fixture
def noted(tmp_path: Path, scene: Scene) -> RunFolder:
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    write_scene(folder, scene, [None])
    return folder


def test_cameras_of_files_are_brought_there(
    tmp_path: Path, scene: Scene, noted: RunFolder, opened: OpenedRun
):
    run = replace(opened, notes=read_scene(noted))
    frames = cameras_of(run, str(tmp_path / "far")).frames
    theirs = {frame.name: frame.camera.viewmat for frame in frames}
    for view in (*scene.train, *scene.test):
        assert torch.equal(theirs[view.name], view.camera.viewmat)

    own = scene.train[0].camera.viewmat
    pose = torch.linalg.inv(own.double())
    pose[:3, 3] += torch.tensor(scene.origin, dtype=torch.float64)
    entry = {"camera_to_world": (pose @ _FLIP).flatten().tolist(), "fov": 60}
    path = {"camera_path": [entry], "render_width": 24, "render_height": 18}
    (tmp_path / "path.json").write_text(json.dumps(path))
    (frame,) = cameras_of(run, str(tmp_path / "path.json")).frames
    torch.testing.assert_close(frame.camera.viewmat, own, atol=1e-5, rtol=0)


def test_notes_without_an_origin_have_none_and_damaged_ones_are_refused(noted: RunFolder):
    content = decode(noted.scene, "vlgs-scene-1")
    for origin in ([0, None, 1], [0, 0], [0, 0, float("inf")], 3):
        content.meta["origin"] = origin
        write_atomically(noted.scene, encode(content, "vlgs-scene-1"))
        with pytest.raises(ValueError, match="origin must be three finite numbers"):
            read_scene(noted)
    del content.meta["origin"]  # as files before 2026-11-26
    write_atomically(noted.scene, encode(content, "vlgs-scene-1"))
    assert read_scene(noted).origin == (0.0, 0.0, 0.0)
