"""``data.train_views`` of photographs: as if the others had not been taken."""

from pathlib import Path

import numpy as np
import pytest
from colmap_scenes import add_dense, add_masks, pycolmap, stems_of, write_scene

from vlgs.data.colmap import load_scene
from vlgs.data.diagnostics import SceneError
from vlgs.data.split import Split


def cut_tracks(root: Path, seen: dict[int, list[int]]) -> np.ndarray:
    """Cut the tracks of some points down to images of these numbers, counted from 1; positions of the points, in order of id."""
    folder = str(root / "sparse" / "0")
    model = pycolmap.Reconstruction(folder)
    for point, images in seen.items():
        for image in set(model.images) - set(images):
            model.delete_observation(image, point - 1)
    for point in set(seen) - set(model.points3D):
        raise AssertionError(f"point {point} went with its track")
    model.write(folder)
    return np.array([model.point3D(i).xyz for i in sorted(model.point3D_ids())], np.float32)


def test_few_train_and_what_only_others_saw_is_not_known(tmp_path: Path):
    stems = write_scene(tmp_path)
    # Of nine, 1 and 9 are held out; of the others 2, 5 and 8 train.
    points = cut_tracks(tmp_path, {1: [3, 4, 6], 2: [1, 2, 9], 3: [2, 8], 4: [1, 9]})
    scene = load_scene(str(tmp_path), train_views=3)
    assert stems_of(scene) == ([stems[1], stems[4], stems[7]], [stems[0], stems[8]])
    assert scene.split == "llff8-3"
    np.testing.assert_array_equal(scene.points.numpy(), points[[2, 4, 5]])
    whole = load_scene(str(tmp_path))
    assert len(whole.points) == len(whole.point_colors) == 6
    all_of_them = load_scene(str(tmp_path), train_views=7)
    assert stems_of(all_of_them) == stems_of(whole)


def test_scenes_of_other_views_are_others_though_they_have_the_same_points(tmp_path: Path):
    write_scene(tmp_path)
    scenes = [load_scene(str(tmp_path), train_views=n) for n in (5, 6, None)]
    assert [len(scene.points) for scene in scenes] == [6, 6, 6]
    assert len({scene.fingerprint for scene in scenes}) == 3


def test_masks_and_labels_are_those_of_the_views_that_are_left(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    add_dense(tmp_path, stems)
    few, whole = (load_scene(str(tmp_path), train_views=n) for n in (2, None))
    assert 0 < len(few.mask_vectors) < len(whole.mask_vectors)
    assert few.classes == whole.classes
    assert all(view.read_masks is not None for view in few.train)
    assert all(view.read_dense_labels is not None for view in few.test)


def test_a_model_without_tracks_keeps_its_points(tmp_path: Path):
    write_scene(tmp_path, text=True)
    folder = tmp_path / "sparse" / "0"
    lines = (folder / "points3D.txt").read_text().splitlines()
    bare = [line if line[0] == "#" else " ".join(line.split()[:8]) for line in lines]
    (folder / "points3D.txt").write_text("\n".join(bare) + "\n")
    images = (folder / "images.txt").read_text().splitlines()
    poses = [line for line in images if line.endswith(".png")]
    (folder / "images.txt").write_text("".join(f"{pose}\n\n" for pose in poses))
    assert len(load_scene(str(tmp_path), train_views=3).points) == 6


def test_tracks_of_other_images_are_refused_where_they_count(tmp_path: Path):
    write_scene(tmp_path, text=True)
    folder = tmp_path / "sparse" / "0"
    text = (folder / "points3D.txt").read_text().splitlines()
    text[-1] = " ".join([*text[-1].split()[:8], "77", "0", "78", "0"])
    (folder / "points3D.txt").write_text("\n".join(text) + "\n")
    assert len(load_scene(str(tmp_path)).points) == 6
    with pytest.raises(SceneError, match=r"points3D\.txt: tracks .* data\.train_views needs"):
        load_scene(str(tmp_path), train_views=3)


@pytest.mark.parametrize(
    ("count", "expected"),
    [(1, "b"), (2, "bh"), (3, "beh"), (4, "bdfh"), (7, "bcdefgh"), (9, "bcdefgh")],
)
def test_they_are_spread_from_the_first_to_the_last(count: int, expected: str):
    train, test = Split(train_views=count).divide("abcdefghi", ())
    assert ("".join(train), "".join(test)) == (expected, "ai")


@pytest.mark.parametrize("options", [{"train_views": 0}, {"train_views": 3, "kind": "all"}])
def test_no_views_and_views_that_are_tested_too_are_refused(options: dict):
    with pytest.raises(ValueError, match="train_views must be at least 1"):
        Split(**options)
