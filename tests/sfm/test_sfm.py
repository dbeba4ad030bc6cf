"""Cameras from photographs: refusals, resuming and what is left behind at once; a real reconstruction is slow."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from vlgs.data.colmap import ColmapSource, survey
from vlgs.data.faults import errors
from vlgs.sfm import reconstruct as module
from vlgs.sfm.__main__ import main
from vlgs.sfm.compare import align, compare_poses
from vlgs.sfm.reconstruct import SfmOptions, reconstruct

pytest.importorskip("pycolmap")
QUIET = Console(quiet=True)


def photographs(folder: Path, count: int = 3, seed: int = 0) -> Path:
    """Noise that nothing can be matched in."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for i in range(count):
        Image.fromarray(rng.integers(0, 256, (48, 64, 3), np.uint8)).save(folder / f"{i}.png")
    return folder


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def test_a_similarity_is_found_again_and_never_a_mirror():
    rng = np.random.default_rng(0)
    points, turn, shift = (
        rng.normal(size=(20, 3)),
        rotation(np.array([1.0, 2, 3]), 2.0),
        rng.normal(size=3),
    )
    scale, found, moved = align(points, 0.3 * points @ turn.T + shift)
    np.testing.assert_allclose(
        (scale, *found.ravel(), *moved), (0.3, *turn.ravel(), *shift), atol=1e-12
    )
    _, found, _ = align(points, points * [1, 1, -1])
    assert np.linalg.det(found) == pytest.approx(1)


def test_cameras_are_compared_in_shares_and_degrees(tmp_path: Path):
    from colmap_scenes import write_scene

    write_scene(tmp_path / "a", text=True)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    same = compare_poses(tmp_path / "a", tmp_path / "b")
    assert same.common == 9
    assert same.centers.max() < 1e-9
    assert same.degrees.max() < 1e-5
    path = tmp_path / "b" / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.endswith("frame_00004.png"))
    words = lines[at].split()
    words[7] = str(float(words[7]) + 0.1)  # ahead along its own axis
    path.write_text("\n".join([*lines[:at], " ".join(words), *lines[at + 1 :]]) + "\n")
    moved = compare_poses(tmp_path / "a", tmp_path / "b")
    assert moved.centers.argmax() == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"matching": "all"}, "matching must be auto, exhaustive or sequential, got all"),
        ({"overlap": 0}, "numbers must be positive"),
        ({"seed": -1}, "numbers must be positive"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str):
    with pytest.raises(ValueError, match=message):
        SfmOptions(**options)


def test_photographs_that_cannot_be_used_are_named(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="images must be a folder"):
        reconstruct(tmp_path / "none", tmp_path / "out", SfmOptions(), QUIET)
    images = photographs(tmp_path / "images", 2)
    with pytest.raises(ValueError, match="at least 3, got 2"):
        reconstruct(images, tmp_path / "out", SfmOptions(), QUIET)
    shutil.copy(images / "0.png", images / "0.jpg")
    with pytest.raises(ValueError, match="different names, got 0 more than once"):
        reconstruct(images, tmp_path / "out", SfmOptions(), QUIET)
    (images / "0.jpg").unlink()
    (images / "bad.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"must be readable, got bad\.png"):
        reconstruct(images, tmp_path / "out", SfmOptions(), QUIET)
    assert not (tmp_path / "out").exists()


def test_a_scene_that_is_there_is_not_overwritten(tmp_path: Path):
    images = photographs(tmp_path / "images")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("x")
    with pytest.raises(FileExistsError, match="must not exist or be empty"):
        reconstruct(images, tmp_path / "out", SfmOptions(), QUIET)
    foreign = tmp_path / ".new.sfm"
    foreign.mkdir()
    (foreign / "mine.txt").write_text("x")
    with pytest.raises(FileExistsError, match="must be a folder of an earlier run"):
        reconstruct(images, tmp_path / "new", SfmOptions(), QUIET)
    assert (foreign / "mine.txt").is_file()


def test_photographs_that_do_not_match_leave_no_scene(tmp_path: Path):
    images = photographs(tmp_path / "images")
    with pytest.raises(ValueError, match="photographs must overlap, got no two of 3") as e:
        reconstruct(images, tmp_path / "out", SfmOptions(max_features=100), QUIET)
    assert "at least 60 % overlap" in str(e.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import os; os.abort()", "got signal 6 at stage not started"),
        ("raise SystemExit('no such camera')", "got status 1 at stage not started: no such camera"),
    ],
)
def test_a_crash_of_the_worker_is_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, message: str
):
    (tmp_path / "worker.py").write_text(code)
    monkeypatch.setattr(module, "__file__", str(tmp_path / "reconstruct.py"))
    images = photographs(tmp_path / "images")
    with pytest.raises(RuntimeError, match=message) as e:
        reconstruct(images, tmp_path / "out", SfmOptions(), QUIET)
    assert "log.txt" in str(e.value)
    assert not (tmp_path / "out").exists()


def test_work_of_other_settings_is_begun_anew_and_equal_work_kept(tmp_path: Path):
    work = tmp_path / ".out.sfm"
    module._prepare(work, {"seed": 0})
    (work / "database.db").write_bytes(b"rows")
    module._prepare(work, {"seed": 0})
    assert (work / "database.db").is_file()
    module._prepare(work, {"seed": 1})
    assert not (work / "database.db").exists()


def test_pairs_are_counted_as_colmap_makes_them():
    assert module._pairs(50, "exhaustive", 10) == 1225
    assert module._pairs(5, "sequential", 2) == 4 + 3  # distances 1, 2
    assert module._pairs(20, "sequential", 3) == 19 + 18 + 17 + 16  # 1, 2, 3 and 4


@pytest.mark.slow
def test_real_photographs_get_the_cameras_that_they_have(
    tmp_path: Path, shared: Path, capsys: pytest.CaptureFixture[str]
):
    images = tmp_path / "images"
    images.mkdir()
    for path in sorted((shared / "data" / "dtu_scan65" / "images").iterdir())[:12]:
        shutil.copy(path, images)
    reference = shared / "data" / "dtu_scan65"
    out = tmp_path / "scene"
    main([str(images), str(out), "--max-features", "2000", "--reference", str(reference)])
    assert "12 of 12 photographs registered" in capsys.readouterr().out
    poses = compare_poses(out, reference)
    assert poses.degrees.max() < 1.0
    assert np.median(poses.centers) < 0.02
    found = survey(ColmapSource(root=str(out)))
    assert found.scene is not None
    assert not errors(found.faults)
    assert json.loads((out / "sfm.json").read_text())["registered"] == 12
    assert not (tmp_path / ".scene.sfm").exists()
