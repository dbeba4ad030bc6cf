"""`vlgs.check`: everything that is wrong with a scene in one list, and an exit status that says so."""

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_scenes import HEIGHT, WIDTH, picture, write_scene
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from test_data_colmap import add_dense, add_masks

from tests.fuzz.commands import command
from vlgs.check import Report, check, check_scene, print_report
from vlgs.config import CONF
from vlgs.data.colmap import load_scene
from vlgs.data.diagnostics import errors


def report(root: Path, **options: object) -> Report:
    config = OmegaConf.merge(
        OmegaConf.load(CONF / "data" / "colmap.yaml"), {"root": str(root)}, options
    )
    assert isinstance(config, DictConfig)
    return check(config)


def test_a_sound_scene_has_a_summary_and_no_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    add_dense(tmp_path, stems)
    found = report(tmp_path)
    assert not errors(found.faults)
    print_report(found)
    out = capsys.readouterr().out
    for expected in (
        "7 train, 2 test (split llff8)",
        f"{WIDTH} x {HEIGHT}",
        "14 vectors of width 8 on 7 training views, 83% of their pixels",
        "2 of 2 test views, 2 classes",
        "usable: 0 errors, 1 warnings",
    ):
        assert expected in out


def test_every_fault_is_listed_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems[:-2])
    add_dense(tmp_path, stems)
    images, maps = tmp_path / "images", tmp_path / "language_features"
    (images / "frame_00001.png").unlink()
    Image.fromarray(picture(0, WIDTH, HEIGHT + 5)).save(images / "frame_00002.png")
    damaged = images / "frame_00003.png"
    damaged.write_bytes(damaged.read_bytes()[:-200])
    np.save(maps / "frame_00004_s.npy", np.full((4, HEIGHT, WIDTH), 77, np.float32))
    np.save(maps / "frame_00005_f.npy", np.zeros((4, 8), np.float32))
    Image.fromarray(np.full((HEIGHT, WIDTH), 9, np.uint8)).save(
        tmp_path / "labels" / "frame_00006.png"
    )
    Image.fromarray(np.zeros((HEIGHT, WIDTH + 1), np.uint8)).save(
        tmp_path / "labels" / "frame_00007.png"
    )
    found = report(tmp_path)
    print_report(found)
    out = capsys.readouterr().out
    expected = [
        "1 of 9 missing: frame_00001.png",
        f"frame_00002.png: size must be {WIDTH} x {HEIGHT} as its camera",
        "frame_00003.png: content must be a whole image",
        "frame_00004_s.npy: ids of level 3 must be whole numbers from -1 to 3",
        "frame_00005_f.npy: rows must be finite and of unit length",
        "frame_00006.png: pixels must be ids of classes.json (3, 5, 255), got 9",
        f"frame_00007.png: labels must be {WIDTH} x {HEIGHT} as their image, got {WIDTH + 1}",
        "make those of frame_00007",
    ]
    for message in expected:
        assert out.count(message) == 1, message
    assert "not usable" in out


def test_sparse_files_that_do_not_read_are_one_fault(tmp_path: Path):
    write_scene(tmp_path)
    path = tmp_path / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:-1])
    (fault,) = report(tmp_path).faults
    assert fault.file == str(path)


def test_an_image_whose_pose_is_broken_is_named(tmp_path: Path):
    write_scene(tmp_path, text=True)
    path = tmp_path / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.endswith("frame_00004.png"))
    words = lines[at].split()
    lines[at] = " ".join([*words[:5], "nan", *words[6:]])
    path.write_text("\n".join(lines) + "\n")
    (fault,) = errors(report(tmp_path).faults)
    assert "image 'frame_00004.png': pose must be finite" in str(fault)


def test_contents_of_a_loaded_scene_are_checked_whatever_it_came_from(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    scene = load_scene(str(tmp_path))
    view = dataclasses.replace(
        scene.train[0],
        read_image=lambda: torch.zeros(4, 5, 3, dtype=torch.uint8),
        read_masks=lambda: torch.full((HEIGHT, WIDTH), -1, dtype=torch.int32),
    )
    scene = dataclasses.replace(scene, train=(view,), test=())
    found = list(map(str, check_scene(scene)))
    assert found[0].startswith(f"{view.name}: image must be ({HEIGHT}, {WIDTH}) (height, width)")
    assert found[1].startswith(f"{view.name}: mask map should reach a pixel")
    assert found[2].startswith(f"{scene.name}: test views should be at least 1")


def test_words_that_the_vocabulary_lacks_are_a_warning(tmp_path: Path):
    stems = write_scene(tmp_path)
    add_masks(tmp_path, stems)
    add_dense(tmp_path, stems)
    np.savez(
        tmp_path / "language_features" / "vocabulary.npz",
        names=np.array(["glass"]),
        embeddings=np.eye(8)[:1],
    )
    found = report(tmp_path)
    assert not errors(found.faults)
    assert any(
        "vocabulary should know every class, got none for wall" in str(f) for f in found.faults
    )


def write_damaged(folder: Path) -> None:
    write_scene(folder)
    (folder / "images" / "frame_00001.png").write_bytes(b"")


@pytest.mark.parametrize(
    ("write", "status", "verdict"),
    [(write_damaged, 1, "not usable: 1 errors"), (write_scene, 0, "\nusable: 0 errors")],
)
def test_the_command_exits_with_the_verdict(
    write: Callable[[Path], object],
    status: int,
    verdict: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    write(tmp_path)
    monkeypatch.chdir(tmp_path)
    done = command("check", ["data=colmap", f"data.root={tmp_path}"])
    assert done.status == status, done.text
    assert verdict in done.text


@pytest.mark.slow
def test_the_process_exits_with_the_verdict(tmp_path: Path):
    write_damaged(tmp_path)
    done = subprocess.run(
        [sys.executable, "-m", "vlgs.check", "data=colmap", f"data.root={tmp_path}"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        cwd=tmp_path,
    )
    assert done.returncode == 1, done.stderr
    assert "not usable: 1 errors" in done.stdout


def test_orientation_tags_are_one_warning(tmp_path: Path):
    stems = write_scene(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6
    for i, stem in enumerate(stems):
        Image.fromarray(picture(i)).save(tmp_path / "images" / f"{stem}.png", exif=exif)
    found = [str(f) for f in report(tmp_path).faults if "EXIF" in str(f)]
    assert len(found) == 1
    assert found[0].endswith("and 4 more; it is ignored, as COLMAP does")
