"""Scenes seen from a ring or an arc, with views between, beyond and above it held out."""

import numpy as np
import pytest
import torch
from torch import Tensor

from vlgs.data.synthetic import NO_NOISE, load_scene
from vlgs.data.synthetic.cameras import ABOVE, BEYOND, HALF_ARC, PAST, RING, stop_at
from vlgs.geometry import camera_center
from vlgs.types import IGNORE_ID, Scene, View


def load(scene: str, train: int = 8) -> Scene:
    return load_scene(
        scene, width=48, height=36, train_views=train, test_views=4, points=600, faults=NO_NOISE
    )


def ids(view: View) -> Tensor:
    assert view.read_dense_labels is not None
    return view.read_dense_labels().ids


def test_the_scenes_of_the_tables_are_what_they_were():
    scene = load_scene(width=64, height=48, train_views=4, test_views=2)
    assert scene.fingerprint == "c382d81b0df1fa91558d7c295841c9fb"


@pytest.mark.usefixtures("unchecked")
def test_a_sky_is_no_class_and_has_neither_masks_nor_points():
    sky = load("mirrors_sky")
    assert "sky" not in sky.classes
    assert set(sky.class_kinds) == set(sky.classes)
    for view in sky.train:
        assert view.read_masks is not None
        seen, mask = ids(view) == IGNORE_ID, view.read_masks()
        assert 0.2 < seen.float().mean() < 0.7
        assert (mask[seen] < 0).all()
        assert (mask[~seen] < 0).float().mean() < 0.05  # slivers
    assert sky.points.norm(dim=1).max() < 3.5
    assert sky.name == "mirrors_sky"


@pytest.mark.usefixtures("unchecked")
def test_a_plain_wall_is_a_class_without_points():
    scene = load("lookalikes_wall")
    assert "wall" in scene.classes
    assert (ids(scene.train[0]) == scene.classes.index("wall")).float().mean() > 0.1
    height = scene.points[scene.points.norm(dim=1) > 1.5][:, 2]
    assert height.max() < 0.1  # floor and strays, nothing of the wall


@pytest.mark.slow
def test_held_out_views_are_between_beyond_and_above():
    scene = load("glassware_ring", train=12)
    centers = [camera_center(v.camera.viewmat).numpy() for v in (*scene.train, *scene.test)]
    distance = np.array([np.linalg.norm(c - (0, 0, 0.07)) for c in centers])
    height = np.array([c[2] for c in centers])
    between, beyond, again, above = distance[12:]
    assert np.allclose(distance[:12], RING, atol=0.05)
    assert np.allclose([between, again, above], RING, atol=0.05)
    assert beyond == pytest.approx(BEYOND * RING, abs=0.05)
    assert height[15] > height[:12].max() + 0.5 * RING * np.radians(ABOVE)
    azimuth = np.unwrap(np.arctan2(*np.array(centers)[:12, 1::-1].T))
    assert np.ptp(azimuth) == pytest.approx(2 * np.pi * 11 / 12, abs=0.15)


def test_beyond_an_arc_is_past_its_ends():
    stops = [stop_at("wall", number, 20, 8) for number in range(8)]
    past = [abs(stop.azimuth + 90) for stop in stops[1::4]]
    assert past == pytest.approx([HALF_ARC + PAST] * 2)
    inside = [abs(stop.azimuth + 90) for number, stop in enumerate(stops) if number % 4 != 1]
    assert max(inside) < HALF_ARC
    trained = {stop_at("wall", number, 20).azimuth for number in range(20)}
    assert min(abs(stop.azimuth - t) for stop in stops for t in trained) > 2


@pytest.mark.usefixtures("unchecked")
def test_every_layout_has_every_stage():
    with pytest.raises(ValueError, match=r"lookalikes_wall.*got 'mirrors_moon'"):
        load_scene("mirrors_moon")
    scene = load("patchwork_sky")
    assert torch.isfinite(scene.points).all()
