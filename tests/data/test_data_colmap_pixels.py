"""Pixels of whole COLMAP scenes: resized and undistorted together with masks and labels, read late, and kept within a limit."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_scenes import (
    HEIGHT,
    RADIAL,
    WIDTH,
    add_dense,
    add_masks,
    picture,
    write_scene,
)
from PIL import Image

from vlgs.data.cache import PixelCache
from vlgs.data.colmap import load_scene, survey
from vlgs.data.diagnostics import SceneError
from vlgs.data.language import find_mask_files
from vlgs.data.lens import Lens
from vlgs.data.source import ColmapSource
from vlgs.data.sparse import SparseCamera
from vlgs.types import IGNORE_ID


def test_everything_follows_resizing(tmp_path: Path):
    stems = write_scene(tmp_path)
    written, dense = add_masks(tmp_path, stems), add_dense(tmp_path, stems)
    scene = load_scene(str(tmp_path), resize=0.5)
    for view in scene.train:
        number = stems.index(view.name)
        assert (view.camera.width, view.camera.height) == (WIDTH // 2, HEIGHT // 2)
        np.testing.assert_allclose(view.camera.K[:2].numpy(), [[10, 0, 6.25], [0, 10.5, 4.25]])
        quads = picture(number).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
        # Pillow rounds after rows and again after columns.
        assert np.abs(view.read_image().numpy() - quads).max() <= 1
        assert view.read_masks is not None
        assert view.read_dense_labels is not None
        # The middle of an output pixel is the corner of four; the one below and to the right counts.
        np.testing.assert_array_equal(
            view.read_masks().numpy() == -1, written[view.name][0][1::2, 1::2] == -1
        )
        ignored = view.read_dense_labels().ids.numpy() == IGNORE_ID
        np.testing.assert_array_equal(ignored, dense[view.name][1::2, 1::2] == 255)
    assert scene.mask_areas.sum() == sum(
        (v.read_masks() >= 0).sum() for v in scene.train if v.read_masks
    )


def test_everything_follows_undistortion(tmp_path: Path):
    """A photograph that shows its own labels still does when both have been undistorted."""
    stems = write_scene(tmp_path, camera=RADIAL)
    blocks = np.kron(np.random.default_rng(0).integers(0, 2, (3, 4)), np.ones((6, 6), int)).astype(
        np.uint8
    )
    add_masks(tmp_path, stems)
    add_dense(tmp_path, stems)
    for stem in stems:
        Image.fromarray(255 * np.repeat(blocks[..., None], 3, 2)).save(
            tmp_path / "images" / f"{stem}.png"
        )
        Image.fromarray(np.where(blocks, 5, 3).astype(np.uint8)).save(
            tmp_path / "labels" / f"{stem}.png"
        )
        ids = np.full((4, HEIGHT, WIDTH), -1, np.float32)
        ids[3] = 2 + blocks
        np.save(tmp_path / "language_features" / f"{stem}_s.npy", ids)
    scene = load_scene(str(tmp_path))
    view = scene.train[0]
    assert (view.camera.width, view.camera.height) != (WIDTH, HEIGHT)
    image = view.read_image()[..., 0]
    assert view.read_masks is not None
    assert view.read_dense_labels is not None
    first = view.read_masks().min()
    # The nearest pixel has at least a quarter of the bilinear weight, so these are certain.
    sure = (image < 255 / 4 - 1) | (image > 255 * 3 / 4 + 1)
    assert sure.float().mean() > 0.6
    assert torch.equal((image > 127)[sure], (view.read_masks() > first)[sure])
    assert torch.equal((image > 127)[sure], view.read_dense_labels().ids[sure] == 1)


def test_where_the_photograph_has_no_pixels_nothing_is_supervised(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    add_dense(tmp_path, stems)
    found = survey(ColmapSource(root=str(tmp_path)))
    (view,) = found.views[:1]
    camera = SparseCamera(1, "SIMPLE_RADIAL", WIDTH, HEIGHT, (20.0, 12.0, 9.0, 0.0))
    wide = SparseCamera(1, "PINHOLE", WIDTH + 8, HEIGHT + 4, (20.0, 20.0, 16.0, 11.0))
    lens = Lens(wide, camera, (WIDTH, HEIGHT), (WIDTH + 8, HEIGHT + 4))
    files = find_mask_files(tmp_path / "language_features", view.name)
    view = dataclasses.replace(
        view, lens=lens, masks=files, level=0, rows=np.arange(-1, 4, dtype=np.int32)
    )
    inside = torch.zeros(HEIGHT + 4, WIDTH + 8, dtype=torch.bool)
    inside[2:-2, 4:-4] = True
    assert view.view().read_valid is not None
    assert torch.equal(view.read_valid(), inside)
    assert torch.equal(view.read_masks() >= 0, inside)
    assert (view.read_dense_labels().ids[~inside] == IGNORE_ID).all()


@pytest.mark.parametrize("cache_bytes", [0, 3 * WIDTH * HEIGHT * 2, 1 << 30])
def test_readers_return_the_same_whatever_is_kept(tmp_path: Path, cache_bytes: int):
    write_scene(tmp_path, camera=RADIAL)
    scene = load_scene(str(tmp_path), cache_bytes=cache_bytes)
    first = [view.read_image().clone() for view in scene.train]
    for _ in range(2):
        for view, expected in zip(scene.train, first, strict=True):
            assert torch.equal(view.read_image(), expected)


@pytest.mark.parametrize("missing", [0, 1])
def test_pixels_are_kept_where_those_of_all_views_fit(tmp_path: Path, missing: int):
    stems = write_scene(tmp_path)
    room = 3 * WIDTH * HEIGHT * len(stems)
    scene = load_scene(str(tmp_path), cache_bytes=room - missing)
    for view in (*scene.train, *scene.test):
        assert (view.read_image() is view.read_image()) == (not missing)


def test_a_photograph_damaged_after_loading_is_named(tmp_path: Path):
    write_scene(tmp_path)
    scene = load_scene(str(tmp_path))
    path = tmp_path / "images" / "frame_00001.png"
    Image.fromarray(picture(0, 8, 8)).save(path)
    with pytest.raises(SceneError, match="size must still be"):
        scene.train[0].read_image()
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(SceneError, match=r"frame_00001\.png: content must be a whole image"):
        scene.train[0].read_image()


def test_the_cache_keeps_what_was_used_last_within_its_limit():
    cache, made = PixelCache(limit=8), []

    def get(key: str, size: int = 4) -> None:
        def make() -> torch.Tensor:
            made.append(key)
            return torch.zeros(size, dtype=torch.uint8)

        cache.get(key, make)
        assert cache.used <= cache.limit

    for key in "abacba":  # c evicts b, b evicts a
        get(key)
    assert made == ["a", "b", "c", "b", "a"]
    get("large", size=9)
    get("large", size=9)
    assert made[5:] == ["large", "large"]
    assert cache.used == 8
