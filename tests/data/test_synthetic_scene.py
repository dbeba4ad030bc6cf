"""The scenes as training and evaluation see them."""

import gc
import inspect
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from slow import with_slow
from torch import Tensor

from vlgs.data.synthetic import NO_NOISE, LabelNoise, SceneSettings, capture, load_scene
from vlgs.data.synthetic.labels import components, object_labels
from vlgs.data.synthetic.layouts import DIFFICULTIES
from vlgs.data.synthetic.scene_file import find_scene
from vlgs.data.untrusted.arrays import Archive
from vlgs.geometry import camera_center
from vlgs.types import ObjectLabels, Scene, View

SMALL: dict[str, Any] = {"width": 64, "height": 48, "train_views": 4, "test_views": 2}


def masks(view: View) -> Tensor:
    assert view.read_masks is not None
    return view.read_masks()


def ids(view: View) -> Tensor:
    assert view.read_dense_labels is not None
    return view.read_dense_labels().ids


def objects(view: View) -> ObjectLabels:
    assert view.read_object_labels is not None
    return view.read_object_labels()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(width=120, height=90, train_views=5, test_views=2)


SCENES = [
    (name, difficulty)
    for name in ("glassware", "mirrors", "lookalikes", "patchwork", "wirework", "rows", "smallware", "sunroom")
    for difficulty in DIFFICULTIES
]  # fmt: skip


# Every scene is loaded, by turns in the one or in the other difficulty.
@pytest.mark.parametrize("chosen", with_slow(SCENES, [*SCENES[1::4], *SCENES[2::4]]), ids="-".join)
@pytest.mark.usefixtures("unchecked")
def test_every_scene_loads(chosen):
    name, difficulty = chosen
    scene = load_scene(name, difficulty, **SMALL)
    assert scene.name == name  # tables look runs up by data.scene
    assert (len(scene.train), len(scene.test)) == (4, 2)
    assert 9 <= len(scene.classes) <= 16
    assert set(scene.class_kinds) == set(scene.classes)
    shiny = [c for c, kind in scene.class_kinds.items() if kind == "translucent_reflective"]
    assert (len(shiny) >= 4) == (name in ("glassware", "mirrors"))
    assert scene.vocabulary is not None
    assert scene.vocabulary.names[: len(scene.classes)] == scene.classes
    for view in (*scene.train, *scene.test):
        image = view.read_image()
        assert image.shape == (48, 64, 3)
        assert image.float().std() > 20
        assert ids(view).max() < len(scene.classes)
        assert set(objects(view).masks) <= set(scene.classes) - {
            "wooden table",
            "wall",
            "tiled floor",
        }
    assert all(view.read_masks is None for view in scene.test)


@pytest.mark.usefixtures("unchecked")
def test_the_same_arguments_give_the_same_bits():
    first = load_scene(**SMALL)
    capture._kept.cache_clear()
    again = load_scene(**SMALL)
    assert first.fingerprint == again.fingerprint
    assert torch.equal(first.points, again.points)
    assert torch.equal(first.mask_vectors, again.mask_vectors)
    for a, b in zip(first.train + first.test, again.train + again.test, strict=True):
        assert torch.equal(a.camera.viewmat, b.camera.viewmat)
        assert torch.equal(a.read_image(), b.read_image())
        assert torch.equal(ids(a), ids(b))
    assert all(
        torch.equal(masks(a), masks(b)) for a, b in zip(first.train, again.train, strict=True)
    )


@pytest.mark.parametrize(
    "change",
    [
        {"scene": find_scene("mirrors")},
        {"difficulty": "hard"},
        {"width": 66},
        {"test_views": 1},
        {"seed": 1},
        {"points": 100},
        {"faults": LabelNoise(noise=0.1)},
    ],
)
def test_whatever_changes_the_scene_changes_the_fingerprint(change):
    base = SceneSettings(**SMALL)
    assert base.fingerprint(3) != SceneSettings(**{**SMALL, **change}).fingerprint(3)
    assert base.fingerprint(3) != base.fingerprint(2)


def test_a_fault_written_out_is_the_same_as_the_preset():
    written = SceneSettings(**SMALL, faults=LabelNoise(missed=0.05))
    assert written.fingerprint(3) == SceneSettings(**SMALL).fingerprint(3)
    assert load_scene(**SMALL).fingerprint == written.fingerprint(3)


@pytest.mark.usefixtures("unchecked")
def test_photographs_are_traced_once_for_all_processes(tmp_path, monkeypatch, caplog):
    cached: dict[str, Any] = SMALL | {"cache": str(tmp_path / "cache")}

    def same(first: Scene, second: Scene) -> bool:
        pairs = zip(first.train + first.test, second.train + second.test, strict=True)
        return torch.equal(first.points, second.points) and all(
            torch.equal(a.read_image(), b.read_image()) and torch.equal(ids(a), ids(b))
            for a, b in pairs
        )

    traced = load_scene(**SMALL)
    assert same(traced, load_scene(**cached))
    assert same(load_scene(**cached, points=7), load_scene(**SMALL, points=7))
    [file] = (tmp_path / "cache").iterdir()

    monkeypatch.setattr(capture, "photograph", lambda *_: pytest.fail("traced again"))
    assert same(traced, load_scene(**cached))

    monkeypatch.undo()
    file.write_bytes(file.read_bytes()[:1000])
    assert same(traced, load_scene(**cached))
    assert "could not be read" in caplog.text


@pytest.mark.slow
def test_mask_levels_share_what_scenes_need_of_the_photographs(tmp_path, monkeypatch):
    cached: dict[str, Any] = SMALL | {"cache": str(tmp_path), "seed": 7}  # that no test has traced
    read, whole = [], Archive.read
    monkeypatch.setattr(Archive, "read", lambda *a: read.append(a[1]) or whole(*a))

    def held() -> list[str]:
        gc.collect()
        return [field for file, *_, field in capture._in_use if file.is_relative_to(tmp_path)]

    for reads in ([0, 0, 2], [1, 1, 5]):  # the first is traced
        scenes = [load_scene(**cached, level=level) for level in (1, 2, 3)]
        assert sorted(held()) == ["image", "part"]
        assert [read.count(field) for field in ("image", "part", "distance")] == reads
        scenes.clear()
        assert not held()


def test_readers_hand_out_values_that_nobody_can_spoil(scene):
    view = scene.train[0]
    for read in (view.read_image, lambda: masks(view), lambda: ids(view)):
        before = read().clone()
        read().zero_()
        assert torch.equal(read(), before)


def test_held_out_views_differ_from_all_training_views(scene):
    train = torch.stack([camera_center(v.camera.viewmat) for v in scene.train])
    for view in scene.test:
        assert (train - camera_center(view.camera.viewmat)).norm(dim=-1).min() > 0.05
    names = [v.name for v in scene.train + scene.test]
    assert len(set(names)) == 7
    assert [v.name for v in scene.train] == sorted(v.name for v in scene.train)


def test_masks_index_the_vectors_and_fill_the_areas(scene):
    counted = torch.zeros(len(scene.mask_vectors))
    for view in scene.train:
        index = masks(view)
        assert index.dtype == torch.int32
        counted += torch.bincount(index[index >= 0].long(), minlength=len(counted))
    assert torch.equal(counted, scene.mask_areas)
    assert (counted > 0).all()
    torch.testing.assert_close(scene.mask_vectors.norm(dim=1), torch.ones(len(counted)))


def test_exact_supervision_agrees_with_the_dense_labels():
    scene = load_scene(**SMALL, faults=NO_NOISE)
    assert scene.vocabulary is not None
    text = scene.vocabulary.vectors[: len(scene.classes)]
    best = (scene.mask_vectors @ text.T).argmax(dim=1)
    for view in scene.train:
        index, truth = masks(view), ids(view)
        there = index >= 0
        assert there.float().mean() > 0.98
        assert torch.equal(best[index[there].long()], truth[there].long())


def test_points_project_onto_pixels_of_their_colour(scene):
    """Where a point is the nearest thing along its ray, the pixel it falls on has its colour."""
    alike = []
    for view in scene.train:
        camera, image = view.camera, view.read_image()
        local = scene.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixel = (local / local[:, 2:]) @ camera.K.T
        x, y = pixel[:, :2].floor().long().unbind(1)
        inside = (local[:, 2] > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        step = image[y[inside], x[inside]].int() - scene.point_colors[inside].int()
        alike.append((step.abs().amax(1) < 32).float().mean())
    assert min(alike) > 0.6  # the rest is hidden, moves with the viewer, or is stray
    assert 3000 < len(scene.points) <= 4000


@pytest.mark.usefixtures("unchecked")
def test_points_lie_on_the_surfaces_that_their_view_sees():
    scene = load_scene("lookalikes", **SMALL)
    taken = capture.open_capture(SceneSettings(find_scene("lookalikes"), **SMALL))
    assert len(scene.points) == 4000  # nothing of glass or steel here, so every candidate is kept
    for shot, points in zip(taken.train, scene.points.split(1000), strict=True):
        center = camera_center(shot.camera.viewmat.double()).numpy()[:, None]
        towards = points.double().numpy().T - center
        length = np.linalg.norm(towards, axis=0)
        hits = taken.world.first_hit(center, towards / length, np.zeros(1000))
        error = np.abs(hits.t / length - 1)
        assert 0.9 < (error < 0.01).mean() < 1  # the rest is stray, or slips off an edge


@pytest.mark.slow
def test_mask_levels_nest_in_number(scene):
    counts = [
        len(load_scene(width=120, height=90, train_views=5, test_views=2, level=k).mask_vectors)
        for k in (1, 2, 3)
    ]
    assert counts[0] > counts[1] > counts[2] == len(scene.mask_vectors)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (
            {"scene": "glasware"},
            "scene must be one of glassware, .*, or the path of a .yaml file, got",
        ),
        ({"scene": "none.yaml"}, "scene must be a file that exists, got none.yaml"),
        ({"difficulty": "harder"}, "difficulty must be one of"),
        ({"level": 4}, "level must be 0, 1, 2 or 3, got 4"),
        ({"width": 0}, "width must be in"),
        ({"train_views": 1}, "train_views must be in"),
        ({"train_views": 4, "test_views": 4}, r"test_views must be in \[0, 3\], got 4"),
        ({"seed": -1}, "seed must be in"),
        ({"points": -1}, "points must be in"),
    ],
)
def test_bad_arguments_are_refused(arguments, named):
    with pytest.raises(ValueError, match=f"synthetic: {named}"):
        load_scene(**arguments)


def test_configuration_mirrors_the_function():
    path = Path(__file__).parents[2] / "conf" / "data" / "synthetic.yaml"
    config = yaml.safe_load(path.read_text())
    assert config.pop("_target_") == "vlgs.data.synthetic.load_scene"
    faults = config.pop("faults")
    assert faults.pop("_target_") == "vlgs.data.synthetic.LabelNoise"
    assert LabelNoise(**faults) == LabelNoise()
    defaults = {name: p.default for name, p in inspect.signature(load_scene).parameters.items()}
    assert defaults.pop("faults") == LabelNoise()
    assert config.pop("cache") == "${results}/cache"
    assert defaults.pop("cache") is None
    assert config == defaults
    named: dict[str, Any] = {"scene": find_scene(defaults["scene"])}
    assert SceneSettings() == SceneSettings(
        **{k: v for k, v in (defaults | named).items() if k != "level"}
    )


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.floats(0.1, 0.9))
def test_components_agree_with_scipy(seed, share):
    mask = np.random.default_rng(seed).random((13, 17)) < share
    got = components(mask)
    want, count = cast("tuple[np.ndarray, int]", ndimage.label(mask, np.ones((3, 3))))
    assert got.max() == count
    pairs = set(zip(got.ravel().tolist(), want.ravel().tolist(), strict=True))
    assert len(pairs) == count + (not mask.all())


@pytest.mark.parametrize("fill", [False, True])
def test_components_of_nothing_and_of_everything(fill):
    assert (components(np.full((3, 5), fill)) == fill).all()


def test_object_labels_have_a_box_per_component_of_a_thing():
    things = np.zeros((10, 12), np.int64)
    things[2:5, 1:4] = 1
    things[2:5, 4:7] = 2  # touches the first, but is another mug
    things[8, 0] = 1  # a sliver
    ids = np.where(things > 0, 1, 0).astype(np.uint8)
    labels = object_labels(ids, things, {1: "mug", 2: "absent"}, smallest=4)
    assert list(labels.masks) == ["mug"]
    assert labels.boxes["mug"].tolist() == [[1, 2, 3, 4], [4, 2, 6, 4]]
    assert labels.masks["mug"].sum() == 18
