"""Labels: LERF-OVS polygons and dense class ids, and everything that can be wrong with them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from vlgs.data.diagnostics import SceneError, errors
from vlgs.data.labels import DenseFolder, ObjectFolder, open_labels
from vlgs.data.labels.objects import crosses_itself, fill_polygons, read_labelled_image
from vlgs.types import IGNORE_ID

SQUARE = [[2, 3], [8, 3], [8, 6], [2, 6]]


def entry(category: Any = "plate", segmentation: Any = SQUARE, bbox: Any = (2, 3, 8, 6)) -> dict:
    return {"category": category, "segmentation": segmentation, "bbox": list(bbox)}


def write_json(folder: Path, *objects: Any, stem: str = "a", **info: Any) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / f"{stem}.json"
    info = {"name": f"{stem}.jpg", "width": 20, "height": 10} | info
    path.write_text(json.dumps({"info": info, "objects": list(objects)}))
    return path


def test_instances_of_a_category_are_one_mask_and_two_boxes(tmp_path: Path):
    other = entry(segmentation=[[10, 1], [12, 1], [12, 2], [10, 2]], bbox=(12, 2, 10, 1))
    write_json(tmp_path, entry(), other, entry("cup", bbox=(2, 3, 8, 6)))
    folder, faults = open_labels(tmp_path)
    assert isinstance(folder, ObjectFolder)
    assert not faults
    image = folder.images["a"]
    masks = {category: image.mask(category) for category in image.categories}
    assert set(masks) == {"plate", "cup"}
    assert masks["plate"].sum() == 7 * 4 + 3 * 2
    assert masks["cup"].sum() == 7 * 4
    np.testing.assert_array_equal(image.boxes()["plate"], [[2, 3, 8, 6], [10, 1, 12, 2]])
    assert folder.sizes == {"a": (20, 10)}


def polygon_area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(0.4, 1.0), min_size=3, max_size=12),
    st.floats(0, 1),
)
def test_filling_is_within_a_border_of_the_polygon(radii: list[float], turn: float):
    angles = 2 * np.pi * (np.arange(len(radii)) + turn) / len(radii)
    polygon = 60 + 50 * np.array(radii)[:, None] * np.stack(
        [np.cos(angles), np.sin(angles)], axis=1
    )
    polygon = np.trunc(polygon)
    mask = fill_polygons([polygon], 120, 120)
    edges = np.roll(polygon, -1, axis=0) - polygon
    # The outline's own pixels are counted whole, so the fill exceeds the area by about half of them.
    border = np.abs(edges).max(axis=1).sum() + len(radii)
    assert polygon_area(polygon) - 1 <= mask.sum() <= polygon_area(polygon) + border
    ys, xs = np.nonzero(mask)
    signed = np.stack(
        [
            (edges[i, 0] * (ys - p[1]) - edges[i, 1] * (xs - p[0])) / max(np.hypot(*edges[i]), 1e-9)
            for i, p in enumerate(polygon)
        ]
    )
    if len(radii) == 3:  # convex: no pixel further than one outside any edge
        assert signed.min() >= -1


@pytest.mark.parametrize(
    ("polygon", "expected"),
    [
        (SQUARE, False),
        ([[0, 0], [4, 4], [4, 0], [0, 4]], True),
        ([[0, 0], [4, 0], [4, 0], [4, 4], [2, 4], [2, 0], [2, 4], [0, 4]], False),  # touches itself
        ([[0, 0], [8, 0], [8, 8], [4, -2], [0, 8]], True),
    ],
)
def test_crossings(polygon: list, expected: bool):
    assert crosses_itself(np.array(polygon, float)) == expected


@pytest.mark.parametrize(
    ("broken", "severity", "message"),
    [
        (entry(segmentation=SQUARE[:2]), "error", "3 or more finite corners, got 2 corners"),
        (entry(segmentation=[[1, 2], [3, float("nan")], [4, 5]]), "error", "finite corners"),
        (entry(segmentation=[1, 2, 3, 4]), "error", "finite corners, got [1, 2, 3, 4]"),
        (entry(segmentation=[[1, 2], [3, 10**400], [4, 5]]), "error", "finite corners"),
        (entry(segmentation=[[1, 2], [3, 1e9], [4, 5]]), "error", "coordinates must be pixels"),
        (entry(bbox=(1, 2, 3)), "error", "bbox must be four finite numbers"),
        (entry(bbox=(1, 2, 3, float("inf"))), "error", "bbox must be four finite numbers"),
        (entry(category=""), "error", "category must be a word, got ''"),
        (entry(category=7), "error", "category must be a word, got 7"),
        ("plate", "error", "object must be a mapping, got str"),
        (
            entry(segmentation=[[30, 1], [35, 1], [35, 5]], bbox=(30, 1, 35, 5)),
            "error",
            "lie in the image",
        ),
        (
            entry(segmentation=[[9, 3], [25, 3], [25, 6]], bbox=(9, 3, 25, 6)),
            "warning",
            "lie in the image",
        ),
        (
            entry(segmentation=[[0, 0], [4, 4], [4, 0], [0, 4]], bbox=(0, 0, 4, 4)),
            "warning",
            "not cross itself",
        ),
        (
            entry(segmentation=[[1, 2], [5, 6], [9, 10]], bbox=(1, 2, 9, 10)),
            "warning",
            "must enclose an area, got corners on a line",
        ),
        (
            entry(segmentation=[[1, 15], [1, 19], [3, 19]], bbox=(15, 1, 19, 3)),
            "error",
            "lie in the image",
        ),
        (
            entry(segmentation=[[0, 9], [3, 9], [3, 0], [0, 0]], bbox=(0, 0, 9, 3)),
            "warning",
            "x and y are swapped",
        ),
    ],
)
def test_faulty_objects_are_named_with_their_place(
    tmp_path: Path, broken: Any, severity: str, message: str
):
    path = write_json(tmp_path, entry(), broken)
    image, faults = read_labelled_image(path)
    assert image is not None
    assert message in str(faults[0])
    assert (faults[0].severity, faults[0].where, faults[0].file) == (
        severity,
        "object 1",
        str(path),
    )


def test_an_object_that_is_there_twice_counts_once(tmp_path: Path):
    image, faults = read_labelled_image(write_json(tmp_path, entry(), entry()))
    assert image is not None
    assert len(image.objects) == 1
    assert "objects must differ, got 'plate' twice" in str(faults[0])


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{}", '{"info": {"width": 4, "height": 4}, "objects": 3}', "[" * 100_000, "\x80"],
)
def test_what_is_no_label_file_is_refused(tmp_path: Path, content: str):
    path = tmp_path / "a.json"
    path.write_bytes(content.encode("latin-1"))
    image, (fault,) = read_labelled_image(path)
    assert image is None
    expected = "UTF-8 text" if content == "\x80" else "LERF-OVS labels"
    assert f"content must be {expected}" in str(fault)


@pytest.mark.parametrize("width", [0, -4, 2.5, "20", True, 10**9])
def test_size_must_be_pixels(tmp_path: Path, width: Any):
    image, (fault,) = read_labelled_image(write_json(tmp_path, width=width))
    assert image is None
    assert "info.width and info.height must be pixels" in str(fault)


CLASSES = {
    "0": {"name": "glass", "kind": "translucent_reflective"},
    "4": {"name": "table", "kind": "other"},
    "2": {"name": "wall"},
    "7": {"name": "unlabelled", "ignore": True},
}


def write_dense(folder: Path, ids: np.ndarray, classes: Any = CLASSES) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "classes.json").write_text(json.dumps({"classes": classes}))
    Image.fromarray(ids).save(folder / "a.png")
    return folder


def test_ids_become_positions_and_ignored_ones_255(tmp_path: Path):
    ids = np.array([[0, 2, 4], [7, 255, 0]], np.uint8)
    folder, faults = open_labels(write_dense(tmp_path, ids))
    assert isinstance(folder, DenseFolder)
    assert not faults
    assert folder.classes == ("glass", "wall", "table")
    assert folder.class_kinds == {"glass": "translucent_reflective", "table": "other"}
    np.testing.assert_array_equal(folder.read_ids("a"), [[0, 1, 2], [IGNORE_ID, IGNORE_ID, 0]])


def test_an_unknown_id_names_the_file(tmp_path: Path):
    folder, _ = open_labels(write_dense(tmp_path, np.array([[0, 9]], np.uint8)))
    assert isinstance(folder, DenseFolder)
    with pytest.raises(SceneError, match=r"a\.png: pixels must be ids of classes\.json .*got 9"):
        folder.read_ids("a")


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        ({}, "classes that count must be at least 1"),
        ({"0": {"name": "a", "ignore": True}}, "classes that count must be at least 1"),
        ({"x": {"name": "a"}}, "class id must be 0 to 254, got 'x'"),
        ({"0": {"name": "a"}, "00": {"name": "b"}}, "class id must be 0 to 254, got '00'"),
        ({"255": {"name": "a"}}, "class id must be 0 to 254, got '255'"),
        ({"0": {"name": "a"}, "1": {"name": "a"}}, "class names must be unique"),
        ({"0": {}}, "class 0: name must be a word, got None"),
        (
            {"0": {"name": "a", "kind": "shiny"}},
            "kind must be one of translucent_reflective, other",
        ),
        ({"0": {"name": "a", "ignore": "no"}}, "ignore must be true or false, got 'no'"),
        ([], "content must be"),
        ({"0": "a"}, "content must be"),
    ],
)
def test_faulty_class_lists_are_refused(tmp_path: Path, classes: Any, message: str):
    folder, faults = open_labels(write_dense(tmp_path, np.zeros((2, 2), np.uint8), classes))
    assert folder is None
    assert message in str(errors(faults)[0])


def test_colour_images_and_damaged_ones_are_no_labels(tmp_path: Path):
    folder = write_dense(tmp_path, np.zeros((2, 2, 3), np.uint8))
    (folder / "b.png").write_bytes(b"PNG")
    _, faults = open_labels(folder)
    assert "a.png: pixels must be one 8-bit id each, got mode RGB" in str(faults[0])
    assert "b.png: content must be a whole image" in str(faults[1])


def test_a_folder_of_neither_kind_says_what_it_should_hold(tmp_path: Path):
    folder, (fault,) = open_labels(tmp_path)
    assert folder is None
    assert "labels must be <stem>.json files (LERF-OVS), or classes.json and <stem>.png" in str(
        fault
    )


def cut_out(mask: np.ndarray) -> Image.Image:
    """White everywhere, and transparent around a mask."""
    pixels = np.full((*mask.shape, 4), 255, np.uint8)
    pixels[..., 3] = np.where(mask, 255, 0)
    return Image.fromarray(pixels)


@pytest.mark.parametrize("suffix", [".png", ".PNG"])
@pytest.mark.parametrize("layout", ["3D-OVS", "GOI"])
def test_masks_end_where_they_are_transparent(tmp_path: Path, layout: str, suffix: str):
    mask = np.zeros((10, 20), bool)
    mask[2:8, 3:9] = True
    path = tmp_path / ("a/cup" if layout == "3D-OVS" else "cup/masks/a")
    path.parent.mkdir(parents=True)
    cut_out(mask).save(path.with_suffix(suffix))
    if layout == "3D-OVS":
        (tmp_path / "classes.txt").write_text("cup\n")
    folder, faults = open_labels(tmp_path)
    assert isinstance(folder, ObjectFolder)
    assert not faults
    np.testing.assert_array_equal(folder.images["a"].mask("cup"), mask)


@pytest.mark.parametrize("mode", ["1", "L", "P", "LA", "RGB", "RGBA"])
def test_opaque_masks_mean_all_that_is_not_black(tmp_path: Path, mode: str):
    mask = np.eye(10, 20, dtype=bool)
    (tmp_path / "classes.txt").write_text("cup\n")
    (tmp_path / "a").mkdir()
    Image.fromarray(mask.astype(np.uint8) * 255).convert(mode).save(tmp_path / "a" / "cup.png")
    folder, _ = open_labels(tmp_path)
    assert isinstance(folder, ObjectFolder)
    np.testing.assert_array_equal(folder.images["a"].mask("cup"), mask)


def test_label_images_may_end_in_capitals_and_must_be_there(tmp_path: Path):
    write_dense(tmp_path, np.array([[0, 2, 4]], np.uint8))
    (tmp_path / "a.png").rename(tmp_path / "a.PNG")
    folder, faults = open_labels(tmp_path)
    assert isinstance(folder, DenseFolder)
    assert not faults
    assert folder.read_ids("a").tolist() == [[0, 1, 2]]
    (tmp_path / "a.PNG").unlink()
    _, (fault,) = open_labels(tmp_path)
    assert fault.severity == "error"
    assert str(fault) == f"{tmp_path}: label images must be at least 1, got 0; name them <stem>.png"


def test_a_key_that_comes_twice_is_refused(tmp_path: Path):
    write_dense(tmp_path, np.array([[3, 5]], np.uint8))
    listed = '{"3": {"name": "glass"}, "3": {"name": "vase"}, "5": {"name": "wall"}}'
    (tmp_path / "classes.json").write_text(f'{{"classes": {listed}}}')
    folder, (fault,) = open_labels(tmp_path)
    assert folder is None
    assert str(fault).endswith("classes.json: content must have every key once, got '3' 2 times")
