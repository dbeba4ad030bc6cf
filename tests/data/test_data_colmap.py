"""Whole COLMAP scenes: joined by stem, divided as asked, lazy, and refused with every fault counted."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_scenes import HEIGHT, WIDTH, picture, write_model, write_scene
from omegaconf import OmegaConf
from PIL import Image

from vlgs.config import CONF
from vlgs.data.cache import PixelCache
from vlgs.data.colmap import load_scene, survey
from vlgs.data.faults import SceneError, errors
from vlgs.data.language import find_mask_files
from vlgs.data.lens import Lens
from vlgs.data.source import ColmapSource
from vlgs.data.sparse import SparseCamera
from vlgs.types import IGNORE_ID, Scene

RADIAL = ("RADIAL", (20.0, 12.5, 8.5, -0.1, 0.02))


def unit_rows(n: int, seed: int, width: int = 8) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(n, width))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def add_masks(root: Path, stems: list[str], width: int = 8) -> dict[str, tuple]:
    """Two masks a view at level 3, after one at level 0 that covers all and one that no pixel has."""
    (root / "language_features").mkdir(exist_ok=True)
    written = {}
    for i, stem in enumerate(stems):
        ids = np.full((4, HEIGHT, WIDTH), -1, np.float32)
        ids[0] = 0
        ids[3, :, 4:] = 2
        ids[3, 5:9, 10:15] = 3
        vectors = unit_rows(4, i, width)
        np.save(root / "language_features" / f"{stem}_s.npy", ids)
        np.save(root / "language_features" / f"{stem}_f.npy", vectors)
        written[stem] = (ids[3], vectors)
    return written


def add_dense(root: Path, stems: list[str]) -> dict[str, np.ndarray]:
    (root / "labels").mkdir(exist_ok=True)
    classes = {"3": {"name": "glass", "kind": "translucent_reflective"}, "5": {"name": "wall"}}
    (root / "labels" / "classes.json").write_text(json.dumps({"classes": classes}))
    written = {}
    for i, stem in enumerate(stems):
        ids = np.random.default_rng(i).choice(np.array([3, 5, 255], np.uint8), (HEIGHT, WIDTH))
        Image.fromarray(ids).save(root / "labels" / f"{stem}.png")
        written[stem] = ids
    return written


def stems_of(scene: Scene) -> tuple[list[str], list[str]]:
    return [v.name for v in scene.train], [v.name for v in scene.test]


def test_photographs_cameras_and_points_are_those_of_the_files(tmp_path: Path):
    stems = write_scene(tmp_path)
    scene = load_scene(str(tmp_path))
    assert stems_of(scene) == (stems[1:8], [stems[0], stems[8]])
    assert scene.split == "llff8"
    for view in (*scene.train, *scene.test):
        number = stems.index(view.name)
        np.testing.assert_array_equal(view.read_image().numpy(), picture(number))
        K = [[20, 0, 12.5], [0, 21, 8.5], [0, 0, 1]]
        np.testing.assert_array_equal(view.camera.K.numpy(), np.array(K, np.float32))
        angle = 0.1 * (number + 1)
        cos, sin = np.cos(angle), np.sin(angle)
        R = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
        np.testing.assert_allclose(view.camera.viewmat[:3, :3].numpy(), R, atol=1e-6)
        np.testing.assert_allclose(view.camera.viewmat[:3, 3].numpy(), [angle, 0.2, 3], atol=1e-6)
        assert view.read_masks is view.read_valid is view.read_dense_labels is None
    assert scene.points.shape == scene.point_colors.shape == (6, 3)
    assert scene.mask_vectors.shape == (0, 512)


def test_views_are_in_order_of_name_whatever_the_order_of_the_model(tmp_path: Path):
    names = ["c.png", "a.png", "d.png", "b.png"]
    write_model(tmp_path / "sparse", names)
    (tmp_path / "images").mkdir()
    for i, name in enumerate(names):
        Image.fromarray(picture(i)).save(tmp_path / "images" / name)
    scene = load_scene(str(tmp_path), split="all")
    assert [view.name for view in scene.train] == ["a", "b", "c", "d"]
    for view in scene.train:
        number = names.index(f"{view.name}.png")
        np.testing.assert_array_equal(view.read_image().numpy(), picture(number))
        np.testing.assert_allclose(view.camera.viewmat[0, 3].item(), 0.1 * (number + 1), rtol=1e-6)


def test_yaml_has_the_keys_and_defaults_of_the_source():
    config = OmegaConf.load(CONF / "data" / "colmap.yaml")
    assert OmegaConf.is_missing(config, "root")
    config.root = "x"
    options = OmegaConf.to_container(config)
    assert isinstance(options, dict)
    assert options.pop("_target_") == "vlgs.data.colmap.load_scene"
    default = vars(ColmapSource(root="x"))
    assert options == default | {"test": []}


def test_splits(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_dense(tmp_path, stems[2:4])
    root = str(tmp_path)
    train, test = stems_of(load_scene(root, every=4))
    assert test == stems[::4]
    assert not set(train) & set(test)
    assert stems_of(load_scene(root, split="all")) == (stems, stems[2:4])
    assert stems_of(load_scene(root, split="holdout")) == (stems[:2] + stems[4:], stems[2:4])
    scene = load_scene(root, split="list", test=[stems[5], stems[1]])
    assert stems_of(scene)[1] == [stems[1], stems[5]]


def test_a_test_view_that_does_not_exist_lists_the_near_ones(tmp_path: Path):
    write_scene(tmp_path)
    with pytest.raises(SceneError, match=r"got 'frame_0004'; near it are .*frame_00004"):
        load_scene(str(tmp_path), split="list", test=["frame_0004"])


def test_no_training_view_is_an_error(tmp_path: Path):
    stems = write_scene(tmp_path, n=2)
    with pytest.raises(SceneError, match="training views must be at least 1, got 0 of 2"):
        load_scene(str(tmp_path), split="list", test=stems)


@pytest.mark.parametrize(
    "options",
    [
        {"resize": 0.0},
        {"resize": 1.5},
        {"level": 4},
        {"split": "random"},
        {"every": 1},
        {"split": "list"},
        {"test": ["a"]},
        {"cache_bytes": -1},
    ],
)
def test_options_out_of_range(tmp_path: Path, options: dict):
    with pytest.raises(ValueError, match=r"must .*, got "):
        load_scene(str(tmp_path), **options)


def test_masks_get_rows_of_training_views_only(tmp_path: Path):
    stems = write_scene(tmp_path)
    written = add_masks(tmp_path, stems)
    scene = load_scene(str(tmp_path))
    assert scene.mask_vectors.shape == (2 * len(scene.train), 8)
    counts = torch.zeros(len(scene.mask_vectors))
    for view in scene.train:
        ids, vectors = written[view.name]
        assert view.read_masks is not None
        rows = view.read_masks()
        assert rows.dtype == torch.int32
        np.testing.assert_array_equal(rows.numpy() == -1, ids == -1)
        found = scene.mask_vectors[rows[rows >= 0].long()].numpy()
        np.testing.assert_allclose(found, vectors[ids[ids >= 0].astype(int)], atol=1e-6)
        counts += torch.bincount(rows[rows >= 0].long(), minlength=len(counts))
    assert torch.equal(counts, scene.mask_areas)
    assert all(view.read_masks is None for view in scene.test)


def test_maps_of_test_views_are_never_opened(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    reference = load_scene(str(tmp_path))
    (tmp_path / "language_features" / f"{stems[0]}_s.npy").write_bytes(b"junk")
    assert load_scene(str(tmp_path)).fingerprint == reference.fingerprint


def test_missing_maps_are_listed_together_or_tolerated(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems[:6])
    with pytest.raises(
        SceneError, match=f"got none for 2 of 7; make those of {stems[6]}, {stems[7]}"
    ):
        load_scene(str(tmp_path))
    scene = load_scene(str(tmp_path), allow_missing_masks=True)
    assert [v.name for v in scene.train if v.read_masks is None] == stems[6:8]


def test_widths_that_differ_and_maps_of_another_size_are_faults(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    add_masks(tmp_path, stems[3:4], width=9)
    path = tmp_path / "language_features" / f"{stems[4]}_s.npy"
    np.save(path, np.full((4, HEIGHT + 1, WIDTH + 1), -1, np.float32))
    found = [str(f) for f in errors(survey(ColmapSource(root=str(tmp_path))).faults)]
    assert len(found) == 2
    assert "vectors must be 8 wide as those of frame_00001, got 9" in found[0]
    assert (
        f"mask map must be {WIDTH} x {HEIGHT} as its image, got {WIDTH + 1} x {HEIGHT + 1}"
        in found[1]
    )
    with pytest.raises(SceneError, match=r"and 1 more: run python -m vlgs\.check"):
        load_scene(str(tmp_path))


def test_no_mask_anywhere_and_another_encoder_are_errors(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    with pytest.raises(SceneError, match="masks of the chosen level must reach a pixel"):
        load_scene(str(tmp_path), level=1)
    path = tmp_path / "language_features" / "vocabulary.npz"
    np.savez(path, names=np.array(["glass"]), embeddings=unit_rows(1, 0, width=9))
    with pytest.raises(SceneError, match="embeddings must be 8 wide as the mask vectors, got 9"):
        load_scene(str(tmp_path))


def test_dense_labels_are_positions_in_classes(tmp_path: Path):
    stems = write_scene(tmp_path)
    written = add_dense(tmp_path, stems)
    scene = load_scene(str(tmp_path))
    assert scene.classes == ("glass", "wall")
    assert scene.class_kinds == {"glass": "translucent_reflective"}
    for view in scene.test:
        assert view.read_dense_labels is not None
        ids, expected = view.read_dense_labels().ids, written[view.name]
        for stored, position in ((3, 0), (5, 1), (255, IGNORE_ID)):
            np.testing.assert_array_equal(ids.numpy() == position, expected == stored)


def add_objects(folder: Path, stem: str, scale: int = 1) -> None:
    folder.mkdir(exist_ok=True)
    square = [
        [2 * scale, 4 * scale],
        [8 * scale, 4 * scale],
        [8 * scale, 6 * scale],
        [2 * scale, 6 * scale],
    ]
    box = [2 * scale, 4 * scale, 8 * scale, 6 * scale]
    info = {"name": f"{stem}.jpg", "width": WIDTH * scale, "height": HEIGHT * scale}
    objects = [{"category": "cup", "segmentation": square, "bbox": box}]
    (folder / f"{stem}.json").write_text(json.dumps({"info": info, "objects": objects}))


@pytest.mark.parametrize("scale", [1, 3])
def test_object_labels_are_scaled_to_the_image(tmp_path: Path, scale: int):
    stems = write_scene(tmp_path)
    add_objects(tmp_path / "label", stems[0], scale)
    scene = load_scene(str(tmp_path), labels=str(tmp_path / "label"), split="holdout")
    assert scene.classes == ("cup",)
    (view,) = scene.test
    assert view.read_object_labels is not None
    labels = view.read_object_labels()
    assert labels.boxes["cup"].tolist() == [[2, 4, 8, 6]]
    inner = labels.masks["cup"][4:6, 2:8]
    assert inner.all()
    assert labels.masks["cup"].sum() <= 7 * 3


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


def test_all_missing_images_are_listed_at_once(tmp_path: Path):
    stems = write_scene(tmp_path)
    for stem in stems[3:6]:
        (tmp_path / "images" / f"{stem}.png").unlink()
    names = ", ".join(f"{stem}.png" for stem in stems[3:6])
    with pytest.raises(
        SceneError, match=f"registered images must all be there, got 3 of 9 missing: {names}"
    ):
        load_scene(str(tmp_path))


def test_scaled_copies_with_another_suffix_are_found(tmp_path: Path):
    stems = write_scene(tmp_path)
    (tmp_path / "images_2").mkdir()
    for stem in stems:
        with Image.open(tmp_path / "images" / f"{stem}.png") as image:
            image.resize((WIDTH // 2, HEIGHT // 2)).save(tmp_path / "images_2" / f"{stem}.JPG")
    masks = add_masks(tmp_path, stems)
    scene = load_scene(str(tmp_path), images="images_2")
    view = scene.train[0]
    assert view.read_image().shape == (HEIGHT // 2, WIDTH // 2, 3)
    np.testing.assert_allclose(view.camera.K[0].numpy(), [10, 0, 6.25])
    assert view.read_masks is not None
    np.testing.assert_array_equal(
        view.read_masks().numpy() < 0, masks[view.name][0][1::2, 1::2] < 0
    )


def test_a_missing_scene_shows_the_tree(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"got no such folder.*\n(.*\n)*  ✗ .*/images/"):
        load_scene(str(tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match="got no sparse model"):
        load_scene(str(tmp_path))
    write_scene(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"got no .*images_4"):
        load_scene(str(tmp_path), images="images_4")
    for key in ("labels", "features", "vocabulary"):
        with pytest.raises(FileNotFoundError, match=f"data: {key} must exist, got .*nowhere"):
            load_scene(str(tmp_path), **{key: "/nowhere"})


def test_labels_of_no_image_are_errors_and_of_unregistered_ones_warnings(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_dense(tmp_path, [*stems, "frame_99999", "extra"])
    Image.fromarray(picture(0)).save(tmp_path / "images" / "extra.png")
    faults = survey(ColmapSource(root=str(tmp_path))).faults
    assert ["no image with stem 'frame_99999'" in str(f) for f in errors(faults)] == [True]
    assert any("labelled image should be registered" in str(f) for f in faults)
    assert any("registered images should be all 10, got 9 of 10" in str(f) for f in faults)


def test_two_images_of_one_stem_are_refused(tmp_path: Path):
    write_model(tmp_path / "sparse", ["left/a.png", "right/a.png", "b.png"])
    for name in ("left/a.png", "right/a.png", "b.png"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture(0)).save(tmp_path / "images" / name)
    with pytest.raises(
        SceneError,
        match=r"right/a\.png: image stems must be unique, got 'a' twice: also .*left/a\.png; rename it",
    ):
        load_scene(str(tmp_path))


def test_fingerprint_follows_content_and_options_but_not_the_place(tmp_path: Path):
    def make(name: str) -> Path:
        root = tmp_path / name
        stems = write_scene(root)
        add_masks(root, stems)
        add_dense(root, stems)
        return root

    a, b = make("a"), make("b")
    reference = load_scene(str(a)).fingerprint
    assert load_scene(str(b)).fingerprint == reference
    assert load_scene(str(b), cache_bytes=0, images="images").fingerprint == reference
    changed = {load_scene(str(b), resize=0.5).fingerprint, load_scene(str(b), every=3).fingerprint}
    Image.fromarray(picture(99)).save(b / "images" / "frame_00002.png")
    changed.add(load_scene(str(b)).fingerprint)
    np.save(b / "language_features" / "frame_00003_f.npy", unit_rows(4, 99))
    changed.add(load_scene(str(b)).fingerprint)
    Image.fromarray(np.full((HEIGHT, WIDTH), 5, np.uint8)).save(b / "labels" / "frame_00004.png")
    changed.add(load_scene(str(b)).fingerprint)
    assert len(changed | {reference}) == 6


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
