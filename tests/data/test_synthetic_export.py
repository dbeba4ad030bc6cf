"""A scene on disk is the scene that was written."""

import os
import signal
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from torch import Tensor

from vlgs.data import colmap
from vlgs.data.export import write_scene
from vlgs.data.export.outline import outlines
from vlgs.data.labels.objects import crosses_itself, fill_polygons
from vlgs.data.sparse import read_cameras
from vlgs.data.sparse.write import write_colmap
from vlgs.data.synthetic import SceneSettings, language_levels, load_scene
from vlgs.types import ObjectLabels, View

SIZE: dict[str, Any] = {"width": 96, "height": 72, "train_views": 4, "test_views": 2}


@pytest.fixture(scope="module")
def scene():
    return load_scene(**SIZE, level=2)


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    root = tmp_path_factory.mktemp("written") / "new" / "scene"
    write_scene(scene, root, language_levels(SceneSettings(**SIZE)))
    return root


def masks(view: View) -> Tensor:
    assert view.read_masks is not None
    return view.read_masks()


def ids(view: View) -> Tensor:
    assert view.read_dense_labels is not None
    return view.read_dense_labels().ids


def objects(view: View) -> ObjectLabels:
    assert view.read_object_labels is not None
    return view.read_object_labels()


def pieces_of(mask: np.ndarray) -> tuple[np.ndarray, int]:
    return cast("tuple[np.ndarray, int]", ndimage.label(mask, np.ones((3, 3))))


def held_out(scene) -> list[str]:
    return [view.name for view in scene.test]


@pytest.mark.parametrize("kind", ["scene", "model"])
def test_what_a_killed_process_left_goes_with_the_next_writing(
    scene, folder, tmp_path, monkeypatch, kind: str
):
    out = tmp_path / "out"

    def write():
        if kind == "scene":
            write_scene(scene, out)
        else:
            write_colmap(out, read_cameras(folder))

    def die(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    child = os.fork()
    if child == 0:
        monkeypatch.setattr("vlgs.data.export.write_sparse", die)
        monkeypatch.setattr("pycolmap.Reconstruction.write", die)
        write()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    assert list(tmp_path.glob(".out*"))
    write()
    assert list(tmp_path.iterdir()) == [out]


def test_reading_gives_back_what_was_written(scene, folder):
    read = colmap.load_scene(root=str(folder), split="list", test=held_out(scene), level=2)
    assert read.classes == scene.classes
    assert read.class_kinds == scene.class_kinds
    assert torch.equal(read.points, scene.points)
    assert torch.equal(read.point_colors, scene.point_colors)
    assert torch.equal(read.mask_areas, scene.mask_areas)
    torch.testing.assert_close(read.mask_vectors, scene.mask_vectors, atol=1e-6, rtol=0)
    assert read.vocabulary is not None
    assert read.vocabulary.names == scene.vocabulary.names
    torch.testing.assert_close(read.vocabulary.vectors, scene.vocabulary.vectors, atol=1e-6, rtol=0)
    for got, want in zip(read.train + read.test, scene.train + scene.test, strict=True):
        assert got.name == want.name
        torch.testing.assert_close(got.camera.viewmat, want.camera.viewmat, atol=1e-6, rtol=0)
        torch.testing.assert_close(got.camera.K, want.camera.K, atol=1e-4, rtol=0)
        assert torch.equal(got.read_image(), want.read_image())
        assert torch.equal(ids(got), ids(want))
    for got, want in zip(read.train, scene.train, strict=True):
        assert torch.equal(masks(got), masks(want))
    assert all(view.read_masks is None for view in read.test)


def test_polygons_give_back_masks_and_boxes(scene, folder):
    labels = str(folder / "label")
    read = colmap.load_scene(root=str(folder), split="list", test=held_out(scene), labels=labels)
    for got, want in zip(read.test, scene.test, strict=True):
        got, want = objects(got), objects(want)
        assert set(got.masks) == set(want.masks)
        for name, mask in want.masks.items():
            pieces, count = pieces_of(mask.numpy())
            filled = [np.asarray(ndimage.binary_fill_holes(pieces == i + 1)) for i in range(count)]
            np.testing.assert_array_equal(got.masks[name].numpy(), np.stack(filled).any(0))
            assert sorted(got.boxes[name].tolist()) == want.boxes[name].tolist()


def test_colmap_reads_the_model(scene, folder):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert model.num_reg_images() == 6
    assert model.num_cameras() == 1
    assert model.num_points3D() == len(scene.points)
    for image in model.images.values():
        for point in image.points2D[:200]:
            track = model.points3D[point.point3D_id]
            seen = image.project_point(track.xyz)
            np.testing.assert_allclose(seen, point.xy, atol=1e-2)


def test_without_language_no_maps_are_written(scene, tmp_path):
    write_scene(scene, tmp_path)
    assert not (tmp_path / "language_features").exists()
    read = colmap.load_scene(root=str(tmp_path), split="llff", every=3)
    assert len(read.mask_vectors) == 0


def test_nothing_is_overwritten_and_nothing_half_written(scene, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match="root must be a new or empty folder"):
        write_scene(scene, tmp_path)
    with pytest.raises(ValueError, match="language must name views of the scene, got nobody"):
        write_scene(scene, tmp_path / "a", {"nobody": ()})
    levels = language_levels(SceneSettings(**SIZE))
    name = scene.train[0].name
    with pytest.raises(ValueError, match="language must have 4 levels, got 3"):
        write_scene(scene, tmp_path / "b", {name: levels[name][1:]})

    def unplugged():
        raise OSError("disk is gone")

    broken = replace(scene, test=(replace(scene.test[0], read_image=unplugged),))
    with pytest.raises(OSError, match="disk is gone"):
        write_scene(broken, tmp_path / "c")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 100_000), share=st.floats(0.05, 0.95), smooth=st.booleans())
def test_filled_outlines_are_the_components_with_holes_closed(seed, share, smooth):
    noise = np.random.default_rng(seed).random((14, 19))
    noise = ndimage.uniform_filter(noise, 3) if smooth else noise
    mask = noise < np.quantile(noise, share)
    pieces, count = pieces_of(mask)
    polygons = outlines(mask)
    assert len(polygons) == count
    for polygon in polygons:
        x, y = polygon[0]
        want = ndimage.binary_fill_holes(pieces == pieces[y, x])
        np.testing.assert_array_equal(fill_polygons([polygon.astype(float)], 19, 14), want)
        assert len(polygon) >= 3
        assert not crosses_itself(polygon.astype(float))


def test_outline_of_a_square_is_its_corners():
    mask = np.zeros((6, 7), bool)
    mask[1:4, 2:6] = True
    (polygon,) = outlines(mask)
    assert {tuple(p) for p in polygon.tolist()} == {(2, 1), (5, 1), (5, 3), (2, 3)}
    assert outlines(np.zeros((3, 3), bool)) == []
