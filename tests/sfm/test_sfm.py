"""Cameras from photographs: refusals, resuming and what is left behind at once; a real reconstruction is slow."""

import io
import json
import shlex
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from vlgs.data.colmap import survey
from vlgs.data.diagnostics import errors
from vlgs.data.source import ColmapSource
from vlgs.sfm import reconstruct as module
from vlgs.sfm.__main__ import main
from vlgs.sfm.compare import align, compare_poses
from vlgs.sfm.photographs import find_photographs
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
    with pytest.raises(
        FileExistsError,
        match="must not exist, be empty or a scene that this command made, got a folder",
    ):
        reconstruct(images, tmp_path / "out", SfmOptions(), QUIET)
    foreign = tmp_path / ".new.sfm"
    foreign.mkdir()
    (foreign / "mine.txt").write_text("x")
    with pytest.raises(FileExistsError, match="must be a folder of an earlier run"):
        reconstruct(images, tmp_path / "new", SfmOptions(), QUIET)
    assert (foreign / "mine.txt").is_file()


FAKE_WORKER = """
import json, pathlib, sys
folder = pathlib.Path(sys.argv[1])
names = json.loads((folder / "settings.json").read_text(encoding="utf-8"))["names"]
(folder / "sparse" / "0").mkdir(parents=True)
parts = [names[:-APART], names[: len(names) // 2], names[-2:]] if APART else [names, names[:3]]
(folder / "models.json").write_text(json.dumps([
    {"folder": str(i), "registered": part, "points": 5, "reprojection_error": 0.5, "cameras": CAMERAS}
    for i, part in enumerate(parts)
]))
(folder / "stage.txt").write_text("done")
"""


def fake_colmap(
    monkeypatch: pytest.MonkeyPatch, folder: Path, apart: int = 0, cameras: int = 1
) -> None:
    code = FAKE_WORKER.replace("APART", str(apart)).replace("CAMERAS", str(cameras))
    (folder / "worker.py").write_text(code)
    monkeypatch.setattr(module, "__file__", str(folder / "reconstruct.py"))


def test_a_finished_scene_is_reported_and_its_command_can_be_pasted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    fake_colmap(monkeypatch, tmp_path)
    images, out = photographs(tmp_path / "Fotos (1)", 6), tmp_path / "Ünï, [b]=c :car:"
    main([str(images), str(out)])
    first = capsys.readouterr().out
    assert "6 of 6 photographs registered" in first
    assert "warning" not in first
    next_command = first.splitlines()[-1].removeprefix("next: ")
    assert shlex.split(next_command)[-1] == f"data.root={out}"
    (tmp_path / "worker.py").write_text("raise SystemExit('must not run again')")
    main([str(images), str(out), "--threads", "1"])
    again = capsys.readouterr().out
    assert again.splitlines() == [
        "this scene exists, nothing was computed",
        *first.splitlines()[-2:],
    ]
    with pytest.raises(SystemExit, match="max_features 8192, now 100; delete it or choose another"):
        main([str(images), str(out), "--max-features", "100"])
    (images / "0.png").unlink()
    with pytest.raises(SystemExit, match="got 6 photographs, now 5 or others"):
        main([str(images), str(out)])


def test_parts_are_told_only_where_photographs_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    fake_colmap(monkeypatch, tmp_path, apart=3, cameras=4)
    main([str(photographs(tmp_path / "images", 20)), str(tmp_path / "out")])
    said = capsys.readouterr().out
    assert "17 of 20 photographs registered" in said
    assert "warning: 2 more fit together (parts of 2), but not with these" in said
    assert "4 cameras were calibrated, but by size and EXIF 1 took the photographs" in said
    assert "--single-camera is more exact" in said


def test_photographs_of_one_size_and_exif_camera_share_a_camera(tmp_path: Path):
    images = photographs(tmp_path / "images", 5)
    exif = Image.Exif()
    exif[271], exif[272] = "Maker", "Model"
    with Image.open(images / "3.png") as image:
        image.copy().save(images / "3.png", exif=exif)
    with Image.open(images / "4.png") as image:
        image.resize((32, 24)).save(images / "4.png")
    groups = find_photographs(images)
    assert list(groups.values()) == [["0.png", "1.png", "2.png"], ["3.png"], ["4.png"]]
    with pytest.raises(
        ValueError, match=r"--single-camera must have .* of one size, got 32 x 24, 64 x 48"
    ):
        reconstruct(images, tmp_path / "out", SfmOptions(single_camera=True), QUIET)


def test_a_scene_among_its_photographs_is_refused(tmp_path: Path):
    images = photographs(tmp_path / "images")
    with pytest.raises(ValueError, match="OUT must lie outside of the photographs"):
        reconstruct(images, images / "scene", SfmOptions(), QUIET)


def test_interrupted_features_go_on_with_the_same_camera(tmp_path: Path):
    images = photographs(tmp_path / "images", 4)
    settings = {
        **asdict(SfmOptions(max_features=50, matching="exhaustive")), "images": str(images),
    }  # fmt: skip
    for names in (["0.png"], ["0.png", "1.png", "2.png", "3.png"]):
        content = json.dumps({**settings, "names": names, "groups": [names]})
        (tmp_path / "settings.json").write_text(content)
        worker = Path(module.__file__).with_name("worker.py")
        subprocess.run([sys.executable, "-P", str(worker), str(tmp_path)], capture_output=True)
    with closing(sqlite3.connect(tmp_path / "database.db")) as base:
        assert base.execute("SELECT COUNT(*) FROM images").fetchone() == (4,)
        assert base.execute("SELECT COUNT(*) FROM cameras").fetchone() == (1,)


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
    said = io.StringIO()
    screen = Console(file=said, soft_wrap=True)
    module._prepare(work, {"seed": 0, "threads": 2}, screen)
    (work / "database.db").write_bytes(b"rows")
    module._prepare(work, {"seed": 0, "threads": 4}, screen)
    assert (work / "database.db").is_file()
    assert json.loads((work / "settings.json").read_text())["threads"] == 4  # the worker's
    assert said.getvalue() == ""
    module._prepare(work, {"seed": 1, "threads": 4}, screen)
    assert not (work / "database.db").exists()
    assert said.getvalue() == f"earlier work in {work} is deleted; changed: seed\n"
    (work / "settings.json").write_text("half of a fi")
    module._prepare(work, {"seed": 1, "threads": 4}, screen)
    assert said.getvalue().endswith("changed: settings.json\n")


def test_another_number_of_threads_goes_on_with_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "worker.py").write_text("raise SystemExit('stopped')")
    monkeypatch.setattr(module, "__file__", str(tmp_path / "reconstruct.py"))
    images, work = photographs(tmp_path / "images"), tmp_path / ".out.sfm"

    def call(*options: str) -> str:
        with pytest.raises(SystemExit, match="COLMAP must end well"):
            main([str(images), str(tmp_path / "out"), *options])
        return capsys.readouterr().out

    call()
    settings = json.loads((work / "settings.json").read_text())
    del settings["photographs"]  # as earlier versions left it
    (work / "settings.json").write_text(json.dumps(settings))
    (work / "database.db").write_bytes(b"rows")
    assert "deleted" not in call("--threads", "4")
    assert (work / "database.db").is_file()
    shutil.rmtree(images)
    photographs(images, seed=1)
    assert "is deleted; changed: photographs\n" in call("--threads", "4")
    assert not (work / "database.db").exists()


def test_other_photographs_of_the_same_names_are_another_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    fake_colmap(monkeypatch, tmp_path)
    first, second = (photographs(tmp_path / name, seed=i) for i, name in enumerate("ab"))
    out = tmp_path / "out"
    made = reconstruct(first, out, SfmOptions(), QUIET)
    with pytest.raises(
        FileExistsError, match="got other photographs of the same names; delete it or choose"
    ):
        reconstruct(second, out, SfmOptions(), QUIET)
    moved = first.rename(tmp_path / "c")  # the same photographs elsewhere
    assert reconstruct(moved, out, SfmOptions(), QUIET).points == made.points
    report = json.loads((out / "sfm.json").read_text())
    del report["made"]["photographs"]  # as earlier versions left it
    (out / "sfm.json").write_text(json.dumps(report))
    assert reconstruct(second, out, SfmOptions(), QUIET).points == made.points


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
