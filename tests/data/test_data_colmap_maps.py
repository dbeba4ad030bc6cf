"""Language maps and labels of whole COLMAP scenes: joined by stem, rows of training views only, and refused with every fault counted."""

from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_scenes import (
    HEIGHT,
    WIDTH,
    add_dense,
    add_masks,
    add_objects,
    picture,
    unit_rows,
    write_scene,
)
from PIL import Image

from vlgs.data.colmap import load_scene, survey
from vlgs.data.diagnostics import SceneError, errors
from vlgs.data.source import ColmapSource
from vlgs.types import IGNORE_ID


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


@pytest.mark.parametrize("scale", [1, 3])
def test_object_labels_are_scaled_to_the_image(tmp_path: Path, scale: int):
    stems = write_scene(tmp_path)
    add_objects(tmp_path / "label", stems[0], scale)
    scene = load_scene(str(tmp_path), labels=str(tmp_path / "label"), split="holdout")
    assert scene.classes == ("cup",)
    (view,) = scene.test
    assert view.read_object_labels is not None
    labels = view.read_object_labels()
    # A third as large, a pixel belongs to the box if its centre does, as to the mask.
    assert labels.boxes["cup"].tolist() == [[2, 4, 8, 6] if scale == 1 else [2, 4, 7, 5]]
    inner = labels.masks["cup"][4:6, 2:8]
    assert inner.all()
    assert labels.masks["cup"].sum() <= 7 * 3


def test_labels_of_no_image_are_errors_and_of_unregistered_ones_warnings(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_dense(tmp_path, [*stems, "frame_99999", "extra"])
    Image.fromarray(picture(0)).save(tmp_path / "images" / "extra.png")
    faults = survey(ColmapSource(root=str(tmp_path))).faults
    assert ["no image with stem 'frame_99999'" in str(f) for f in errors(faults)] == [True]
    assert any("labelled image should be registered" in str(f) for f in faults)
    assert any("registered images should be all 10, got 9 of 10" in str(f) for f in faults)
