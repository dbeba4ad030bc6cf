"""What `vlgs.check` says of language maps nobody reads and of scenes that load but cannot be meant so."""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from colmap_scenes import HEIGHT, WIDTH, write_scene
from test_check_scene import report
from test_data_colmap import add_dense, add_masks, unit_rows
from tiny_runs import composed

from vlgs.check import check_scene, training_memory
from vlgs.data.diagnostics import errors
from vlgs.experiment import construct
from vlgs.types import Scene


def said(root: Path, **options: object) -> str:
    return "\n".join(f"{f.severity} {f}" for f in report(root, **options).faults)


def test_maps_that_nobody_reads_are_named(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, [*stems, "frame_99999"])
    maps = tmp_path / "language_features"
    (maps / "frame_00000_s.npy").unlink()  # of test views, so that no training view lacks its own
    (maps / "frame_00008_f.npy").unlink()
    found = said(tmp_path)
    assert "<stem>_f.npy without <stem>_s.npy for frame_00000" in found
    assert "<stem>_s.npy without <stem>_f.npy for frame_00008" in found
    assert "belong to a registered photograph, got others: frame_99999" in found
    assert not errors(report(tmp_path).faults)


def test_all_faults_of_the_maps_are_told_together(tmp_path: Path):
    """Maps that are missing, of another size, of another width, out of range, all -1."""
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    maps = tmp_path / "language_features"
    (maps / "frame_00001_s.npy").unlink()
    (maps / "frame_00001_f.npy").unlink()
    for stem, (dy, dx) in {"frame_00002": (1, 1), "frame_00003": (-1, -1)}.items():
        ids = np.full((4, HEIGHT + dy, WIDTH + dx), -1, np.float32)
        np.save(maps / f"{stem}_s.npy", ids)
    np.save(maps / "frame_00005_f.npy", unit_rows(4, seed=0, width=3))
    ids = np.full((4, HEIGHT, WIDTH), -1, np.float32)
    ids[3] = -2
    np.save(maps / "frame_00006_s.npy", ids)
    found = said(tmp_path)
    for expected in (
        "got none for 1 of 7; make those of frame_00001",
        f"must be {WIDTH} x {HEIGHT} as its image, got {WIDTH + 1} x {HEIGHT + 1}",
        f"must be {WIDTH} x {HEIGHT} as its image, got {WIDTH - 1} x {HEIGHT - 1}",
        "frame_00005_f.npy: vectors must be 8 wide as those of frame_00004, got 3",
        "ids of level 3 must be whole numbers from -1 to 3, the rows of frame_00006_f.npy, got -2.0",
    ):
        assert found.count(expected) == 1, expected
    assert len(errors(report(tmp_path).faults)) == 5


def test_a_view_without_any_mask_is_a_warning_and_a_scene_without_any_an_error(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    nothing = np.full((4, HEIGHT, WIDTH), -1, np.float32)
    np.save(tmp_path / "language_features" / "frame_00001_s.npy", nothing)
    assert "warning frame_00001: mask map should reach a pixel" in said(tmp_path)
    for stem in stems:
        np.save(tmp_path / "language_features" / f"{stem}_s.npy", nothing)
    assert "masks of the chosen level must reach a pixel, got -1 everywhere" in said(tmp_path)


def test_compressed_codes_are_not_taken_for_vectors(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems, width=3)
    assert "these look like LangSplat's codes (language_features_dim3)" in said(tmp_path)


def test_labels_that_no_test_view_has_are_a_warning(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_dense(tmp_path, stems[1:3])
    assert "got 2 of which none is held out; nothing is scored: set data.split=holdout" in said(
        tmp_path
    )
    assert "none is held out" not in said(tmp_path, split="holdout")


def doubts(scene: Scene) -> str:
    return "\n".join(map(str, check_scene(scene)))


def scaled(scene: Scene, factor: float) -> Scene:
    """The same pictures of a world of another size."""

    def move(view):
        viewmat = view.camera.viewmat.clone()
        viewmat[:3, 3] *= factor
        return dataclasses.replace(view, camera=dataclasses.replace(view.camera, viewmat=viewmat))

    train, test = (tuple(map(move, views)) for views in (scene.train, scene.test))
    return dataclasses.replace(scene, points=scene.points * factor, train=train, test=test)


def test_a_world_too_small_for_the_near_plane_is_a_warning(tiny_scene: Scene):
    assert "median depth" not in doubts(tiny_scene)
    assert "what is nearer than 0.01 is not drawn" in doubts(scaled(tiny_scene, 1e-3))
    assert "should be 0.1 to 100000 world units" in doubts(scaled(tiny_scene, 1e7))


def test_a_point_before_the_lens_is_a_warning(tiny_scene: Scene):
    view = tiny_scene.train[2]
    viewmat = view.camera.viewmat
    before = viewmat[:3, :3].T @ (torch.tensor([0.0, 0.0, 1e-3]) - viewmat[:3, 3])
    points = torch.cat([tiny_scene.points, before[None]])
    colors = torch.cat([tiny_scene.point_colors, tiny_scene.point_colors[:1]])
    found = doubts(dataclasses.replace(tiny_scene, points=points, point_colors=colors))
    assert f"got nearer ones in {view.name};" in found


def test_a_camera_that_sees_no_point_is_a_warning(tiny_scene: Scene):
    view = tiny_scene.train[0]
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ view.camera.viewmat
    turned = dataclasses.replace(view, camera=dataclasses.replace(view.camera, viewmat=away))
    scene = dataclasses.replace(tiny_scene, train=(turned, *tiny_scene.train[1:]))
    assert f"should see a sparse point, got none in {view.name};" in doubts(scene)


def test_one_word_in_two_spellings_is_a_warning(tiny_scene: Scene):
    scene = dataclasses.replace(tiny_scene, classes=("wine glass", "Wine-glass", "cup"))
    assert "got 'wine glass', 'Wine-glass'; each is scored" in doubts(scene)


def test_memory_of_a_run_is_told_and_doubted():
    line, found = training_memory(construct(composed("gaussians.max_count=1000", "head.dim=3")))
    assert line.startswith("training    1 MiB for 1000 Gaussians")  # 63 x 16 bytes each
    assert not found
    _, found = training_memory(construct(composed("gaussians.max_count=1000000000")))
    assert "Gaussians should take at most half of the memory" in str(found[0])
    for method in ("lerf", "opennerf"):  # they have none
        assert training_memory(construct(composed(f"method={method}"))) == ("", ())
    assert training_memory(construct(composed("method=fmgs")))[0]


def test_a_sound_scene_gives_no_doubt(tiny_scene: Scene):
    assert not list(check_scene(tiny_scene))
