"""Whole COLMAP scenes: joined by stem, divided as asked, and refused with every fault counted."""

from pathlib import Path

import numpy as np
import pytest
from colmap_scenes import (
    HEIGHT,
    PINHOLE,
    WIDTH,
    add_dense,
    add_masks,
    picture,
    pycolmap,
    stems_of,
    unit_rows,
    write_model,
    write_scene,
)
from omegaconf import OmegaConf
from PIL import Image

from vlgs.config import CONF
from vlgs.data.colmap import load_scene, survey
from vlgs.data.diagnostics import SceneError
from vlgs.data.source import ColmapSource


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


def test_a_camera_for_each_image_is_doubtful(tmp_path: Path):
    write_scene(tmp_path)
    sparse = tmp_path / "sparse" / "0"
    model = pycolmap.Reconstruction(str(sparse))
    apart = pycolmap.Reconstruction()
    for number, image in model.images.items():
        lens = {"model": PINHOLE[0], "params": PINHOLE[1], "width": WIDTH, "height": HEIGHT}
        apart.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=number, **lens))
        other = pycolmap.Image(name=image.name, camera_id=number, image_id=number)
        apart.add_image_with_trivial_frame(other, image.cam_from_world())
    apart.write(str(sparse))
    faults = survey(ColmapSource(root=str(tmp_path))).faults
    assert any("should share a camera, got 9 cameras" in str(fault) for fault in faults)
