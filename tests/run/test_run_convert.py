"""`python -m vlgs.convert` from the shell, and runs that start from what it reads."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_scenes import pycolmap, write_model, write_scene
from plyfile import PlyData, PlyElement
from safetensors.torch import load_file
from tiny_runs import TINY, composed

from vlgs.convert import convert, main
from vlgs.data.sparse import read_cameras
from vlgs.data.sparse.write import write_colmap
from vlgs.formats import write_autoencoder
from vlgs.gaussians import STANDARD, read_ply, write_ply
from vlgs.gaussians.ply import PLAIN
from vlgs.heads.autoencoder import Autoencoder, AutoencoderTraining
from vlgs.opened.files import write_scene as write_notes
from vlgs.run import run
from vlgs.runs import RunFolder
from vlgs.types import Scene

PARAMETERS = tuple(STANDARD)[:8]
"""What every training has."""


def some_gaussians(n: int = 40, width: int = 3) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {
        "means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "sh0": (n, 3), "shN": (n, 15, 3),
        "opacity_logits": (n,), "indicator_logits": (n,), "features": (n, width),
    }  # fmt: skip
    params = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    return params | {"log_scales": params["log_scales"] * 0.1 - 2}


def test_the_command_says_what_it_did_and_what_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    write_ply(tmp_path / "a.ply", some_gaussians(), notes=[PLAIN])
    main([str(tmp_path / "a.ply"), str(tmp_path / "b.splat")])
    out = capsys.readouterr().out.splitlines()
    assert out[0].endswith(
        "b.splat: 40 Gaussians as 32 bytes a Gaussian; no view dependence, no language"
    )
    assert out[1:] == [
        "not kept: spherical harmonics above degree 0",
        "not kept: colours above 1, of 3 Gaussians",
        "not kept: language features",
        "not kept: indicators",
    ]
    assert (tmp_path / "b.splat").stat().st_size == 40 * 32
    convert(tmp_path / "b.splat", tmp_path / "c.ply")  # without language: 3DGS's own columns
    assert b"lang_0" not in (tmp_path / "c.ply").read_bytes()


def test_a_chain_of_formats_ends_where_it_began(tmp_path: Path):
    params = some_gaussians()
    write_ply(tmp_path / "a.ply", params)
    convert(tmp_path / "a.ply", tmp_path / "b.pth", "langsplat")
    convert(tmp_path / "b.pth", tmp_path / "c.ply", "feature3dgs")
    convert(tmp_path / "c.ply", tmp_path / "d.ply")
    back = read_ply(tmp_path / "d.ply")
    assert all(torch.equal(back[k], params[k]) for k in PARAMETERS if k != "indicator_logits")


def write_compressed(path: Path) -> None:
    """As PlayCanvas and SuperSplat do: bounds of 256 Gaussians at a time, and four packed words for each."""
    bounds = [f"{end}_{what}" for what in ("x", "scale_x") for end in ("min", "max")]
    packed = [f"packed_{what}" for what in ("position", "rotation", "scale", "color")]
    elements = [
        PlyElement.describe(np.zeros(1, [(name, "<f4") for name in bounds]), "chunk"),
        PlyElement.describe(np.zeros(2, [(name, "<u4") for name in packed]), "vertex"),
    ]
    PlyData(elements, byte_order="<").write(str(path))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.ply", "b.ply"], "IN must exist"),
        (["a.ply", "a.ply"], "OUT must be another path than IN"),
        (["a.ply", "b.pth"], "OUT needs --as 3dgs or langsplat"),
        (["a.ply", "b.obj"], "OUT must end in .ply, .compressed.ply, .splat, .pth, got b.obj"),
        (["a.ply", "b.ply", "--as", "splat"], "OUT must end in .splat for --as splat"),
        (["a.ply", "none/b.ply"], "No such file or directory"),
        (["bad.splat", "b.ply"], "log_scales must be finite, got 2 of 2 rows that are not"),
        (["a.spz", "b.ply"], "got a.spz, Niantic's compressed Gaussians; SuperSplat exports it"),
        (["a.compressed.ply", "b.splat"], "must be uncompressed, got the compressed.ply of PlayC"),
        (["a.ply", "b.compressed.ply", "--as", "vlgs"], "OUT must end in .ply for --as vlgs"),
        (["unfinished", "b.ply"], "must have a point_cloud.ply, got none; the command of the run"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(
    tmp_path: Path, arguments: list[str], message: str
):
    write_ply(tmp_path / "a.ply", some_gaussians())
    (tmp_path / "bad.splat").write_bytes(bytes(64))
    (tmp_path / "a.spz").write_bytes(b"\x1f\x8b")
    write_compressed(tmp_path / "a.compressed.ply")
    (tmp_path / "unfinished").mkdir()
    (tmp_path / "unfinished" / "config.yaml").write_text("seed: 0\n")
    before = sorted(tmp_path.iterdir())
    paths = [str(tmp_path / name) for name in arguments[:2]]
    with pytest.raises(SystemExit) as stopped:
        main([*paths, *arguments[2:]])
    assert str(stopped.value).startswith("error: ")
    assert message in str(stopped.value)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["scene", "points.ply"], "OUT must be a .json or a folder for cameras, got points.ply, a"),
        (["scene", "a.PTH", "--as", "colmap"], "OUT must be a .json or a folder for cameras"),
        (["scene", "out", "--drop"], "--drop must go with Gaussians, got cameras"),
        (["scene", "t.json", "--drop"], "--drop must go with Gaussians, got cameras in a .json"),
        (["scene", "t.json", "--as", "splat"], "--as must not be given for cameras in a .json"),
        (
            ["scene", "out", "--as", "splat"],
            "--as must be colmap or colmap-text for cameras, got s",
        ),
        (["b.pth", "a.safetensors", "--drop"], "--drop must go with Gaussians, got an autoencoder"),
        (["b.pth", "a.safetensors", "--as", "3dgs"], "--as must not be given for an autoencoder"),
        (["maps", "dim3", "--head", "b.pth", "--drop"], "--drop must go with Gaussians, got lang"),
        (
            ["maps", "dim3", "--head", "b.pth", "--as", "vlgs"],
            "--as must not be given for language",
        ),
    ],
)
def test_options_that_would_do_nothing_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
):
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "scene", n=3)
    head = Autoencoder(training=AutoencoderTraining(steps=2))
    head.fit(torch.randn(8, 16), torch.ones(8))
    write_autoencoder(tmp_path / "b.pth", head)
    (tmp_path / "maps").mkdir()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert str(stopped.value).startswith("error: convert: ")
    assert message in str(stopped.value)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (500_123.0, 5_412_345.5, 312.0)])
def test_a_run_says_what_was_subtracted(
    tmp_path: Path, tiny_scene: Scene, origin: tuple[float, float, float]
):
    run = RunFolder(tmp_path / "run")
    run.path.mkdir()
    write_ply(run.ply, some_gaussians(), notes=[PLAIN])
    write_notes(run, replace(tiny_scene, origin=origin), [None])
    said = [line for line in convert(run.path, tmp_path / "a.ply") if "subtracted" in line]
    far = ["beware: (500123, 5412345.5, 312) is subtracted from all positions"]
    assert said == (far if any(origin) else [])


def test_colmap_to_colmap_keeps_tracks(tmp_path: Path):
    write_scene(tmp_path / "scene", n=4)
    convert(tmp_path / "scene", tmp_path / "text", "colmap-text")
    convert(tmp_path / "text", tmp_path / "binary")
    models = [
        pycolmap.Reconstruction(str(folder))
        for folder in (tmp_path / "scene/sparse/0", tmp_path / "text", tmp_path / "binary")
    ]
    for model in models:
        assert [p.track.length() for p in model.points3D.values()] == [4] * 6
        for number, point in model.points3D.items():
            assert np.array_equal(point.xyz, models[0].points3D[number].xyz)
            assert str(point.track) == str(models[0].points3D[number].track)
        for number, image in model.images.items():
            assert image.num_points2D() == 6
            xy = [p.xy for p in image.points2D]
            assert np.array_equal(xy, [p.xy for p in models[0].images[number].points2D])
            assert image.cam_from_world() == models[0].images[number].cam_from_world()


@pytest.mark.parametrize("form", ["colmap", "colmap-text"])
def test_names_with_blanks_stay_whole(tmp_path: Path, form: str):
    names = ["my photo 1.png", "two  blanks.png", "sub folder/line\u2028end.png"]
    write_model(tmp_path / "text", names, text=True)
    convert(tmp_path / "text", tmp_path / "out", form)
    assert sorted(image.name for image in read_cameras(tmp_path / "out").images) == sorted(names)


def test_images_that_colmap_reads_otherwise_are_refused(tmp_path: Path):
    write_model(tmp_path / "text", ["a.png", "b.png"], text=True)
    read = replace(model := read_cameras(tmp_path / "text"), images=model.images[:1])
    with pytest.raises(ValueError, match=r"must hold 1 images and 6 points .* got 2 and 6"):
        write_colmap(tmp_path / "out", read)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("form", "file"), [("colmap", "images.bin"), ("colmap-text", "rigs.txt")])
def test_a_model_that_is_not_written_whole_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str, file: str
):
    """As on a full disk, of which COLMAP's writer says nothing."""
    write_scene(tmp_path / "scene", n=3)
    name = "write_text" if form == "colmap-text" else "write"
    write = getattr(pycolmap.Reconstruction, name)

    def cut(self: object, folder: str) -> None:
        write(self, folder)
        path = Path(folder, file)
        path.write_bytes(path.read_bytes()[:-3])

    monkeypatch.setattr(pycolmap.Reconstruction, name, cut)
    with pytest.raises(OSError, match=rf"{tmp_path / 'out'} must hold 1 cameras, 3 images and 6 p"):
        convert(tmp_path / "scene", tmp_path / "out", form)
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_tracks_of_no_image_are_one_line_and_leave_nothing(tmp_path: Path):
    write_scene(tmp_path / "scene", n=3, text=True)
    points = tmp_path / "scene/sparse/0/points3D.txt"
    points.write_text(points.read_text().rstrip().rsplit(" ", 2)[0] + " 77 0\n")
    with pytest.raises(ValueError, match=r"tracks and rigs of .* must be those of its images"):
        convert(tmp_path / "scene", tmp_path / "out")
    assert not (tmp_path / "out").exists()


DROPPED = "left out: 1 rows, log_scales must be finite"


def test_rows_that_are_not_finite_are_left_out_where_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    Path("a.splat").write_bytes(bytes(32))
    main(["a.splat", "b.ply", "--drop"])
    assert DROPPED in capsys.readouterr().out


@pytest.mark.slow
def test_as_a_program(tmp_path: Path):
    (tmp_path / "a.splat").write_bytes(bytes(32))
    command = [sys.executable, "-m", "vlgs.convert", "a.splat", "b.ply", "--drop"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert DROPPED in done.stdout


def test_a_run_starts_from_a_file_and_its_content_is_part_of_the_id(tmp_path: Path):
    write_ply(tmp_path / "a.ply", some_gaussians(200))
    convert(tmp_path / "a.ply", tmp_path / "copy.ply")
    options = [
        *TINY,
        f"results={tmp_path}",
        "trainer=smoke",
        "trainer.iterations=2",
        "pictures=false",
    ]

    def go(name: str) -> set[str]:
        assert run(composed(*options, f"gaussians.init={tmp_path / name}")) == 0
        return {path.name for path in (tmp_path / "runs").iterdir()}

    (first,) = go("a.ply")
    assert go("copy.ply") == {first}  # the same content elsewhere is the same run
    metrics = json.loads((tmp_path / "runs" / first / "metrics.json").read_text())
    assert metrics["n_gaussians"] == 200
    moved = read_ply(tmp_path / "runs" / first / "point_cloud.ply")["means"]
    assert (moved - some_gaussians(200)["means"]).abs().max() < 0.1
    write_ply(tmp_path / "copy.ply", some_gaussians(100))
    assert len(go("copy.ply")) == 2


def test_a_run_takes_the_weights_of_an_autoencoder(tmp_path: Path, tiny_scene: Scene):
    head = Autoencoder(training=AutoencoderTraining(steps=20))
    head.fit(tiny_scene.mask_vectors, tiny_scene.mask_areas)
    write_autoencoder(tmp_path / "best_ckpt.pth", head)
    weights = f"head.weights={tmp_path / 'best_ckpt.pth'}"
    options = [
        *TINY,
        f"results={tmp_path}",
        "trainer=smoke",
        "trainer.iterations=1",
        "pictures=false",
    ]
    assert run(composed(*options, weights)) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    (saved,) = (folder / "checkpoint").glob("*.safetensors")
    kept = load_file(saved)["model.head.encoder.0.weight"]
    assert torch.equal(kept, head.state_dict()["encoder.0.weight"])
    with pytest.raises(FileNotFoundError, match="weights must be a file"):
        run(composed(*options, "head.weights=nowhere.pth"))
