"""Photographs through a real lens: of a procedural scene, which stand in tests/fixtures, and real ones, where they lie beside the checkout."""

from pathlib import Path

import numpy as np
import pytest
import torch

from vlgs.check import check_scene
from vlgs.data.colmap import load_scene, survey
from vlgs.data.diagnostics import errors
from vlgs.data.labels import ObjectFolder, open_labels
from vlgs.data.labels.objects import LabelledImage
from vlgs.data.source import ColmapSource

SHARED = Path(__file__).parents[2] / "../shared/data"
OURS = Path(__file__).parents[1] / "fixtures" / "photographs"
needs_data = pytest.mark.skipif(not SHARED.is_dir(), reason="no real data beside the checkout")


@pytest.mark.parametrize(
    ("root", "views", "points", "size"),
    [
        (OURS, (7, 2), 283, (97, 72)),
        pytest.param(SHARED / "dtu_scan65", (42, 7), 3513, (800, 600), marks=needs_data),
        pytest.param(SHARED / "camvid_0016E5", (88, 13), 3897, (492, 364), marks=needs_data),
        pytest.param(SHARED / "fox", (43, 7), 10900, (530, 946), marks=needs_data),
    ],
)
def test_scenes_load(root: Path, views: tuple[int, int], points: int, size: tuple[int, int]):
    scene = load_scene(str(root))
    assert (len(scene.train), len(scene.test), len(scene.points)) == (*views, points)
    assert {(v.camera.width, v.camera.height) for v in scene.train} == {size}


@pytest.mark.parametrize(
    ("root", "classes", "views"),
    [
        (OURS, 12, 9),
        pytest.param(SHARED / "camvid_0016E5", 11, 101, marks=needs_data),
    ],
)
def test_labelled_photographs_are_sound(root: Path, classes: int, views: int):
    scene = load_scene(str(root), split="all")
    assert len(scene.classes) == classes
    assert len(scene.train) == len(scene.test) == views
    assert not errors(check_scene(scene))


@pytest.mark.parametrize(
    ("root", "every"), [(OURS, 1), pytest.param(SHARED / "fox", 7, marks=needs_data)]
)
def test_points_project_onto_pixels_of_their_brightness(root: Path, every: int):
    """Two pixels off is worse: so axes, order, principal point and undistortion are right to about a pixel."""
    scene = load_scene(str(root))
    margin = 4
    for view in scene.train[::every]:
        image = view.read_image().float().mean(dim=2)
        camera = scene.points @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        xy = ((camera @ view.camera.K.T)[:, :2] / camera[:, 2:]).floor().long()
        size = torch.tensor([view.camera.width, view.camera.height])
        seen = (camera[:, 2] > 0) & (xy >= margin).all(dim=1) & (xy < size - margin).all(dim=1)
        x, y = xy[seen].T
        brightness = scene.point_colors[seen].float().mean(dim=1)
        agreement = {
            shift: torch.corrcoef(torch.stack([image[y + shift, x + shift], brightness]))[0, 1]
            for shift in (-4, -2, 0, 2, 4)
        }
        assert max(agreement, key=lambda shift: agreement[shift]) == 0


@needs_data
def test_a_partial_model_says_so():
    root = SHARED / "odd_colmap_models" / "partial_15_of_100"
    found = survey(ColmapSource(root=str(root)))
    assert found.scene is not None
    messages = [str(fault) for fault in found.faults]
    for expected in (
        "registered images should be all 100, got 15 of 100",
        "images of one device should share a camera, got 15 cameras",
        "sparse points should be in the thousands, got 74",
    ):
        assert sum(expected in message for message in messages) == 1


@needs_data
def test_lerf_ovs_polygons_have_the_area_that_the_file_states():
    folder, faults = open_labels(SHARED / "lerf_ovs_label_sample" / "label" / "teatime")
    assert isinstance(folder, ObjectFolder)
    assert not errors(faults)
    image = folder.images["frame_00140"]
    assert isinstance(image, LabelledImage)
    assert (image.width, image.height) == (988, 730)
    for item, area in zip(image.objects, (33084.5, 36045.5), strict=True):
        x, y = item.polygon.T
        assert abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2 == area
    for category in image.categories:
        mask = image.mask(category)
        objects = [item for item in image.objects if item.category == category]
        outline = sum(len(item.polygon) for item in objects) * 40
        area = dict(zip((o.category for o in image.objects), (33084.5, 36045.5), strict=True))[
            category
        ]
        assert area <= mask.sum() <= area + outline
