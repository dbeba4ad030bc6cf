"""Two tiny runs side by side: the pictures are what the runs show, and what is lost or damaged is said."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_runs import TINY, composed

from vlgs.gallery.__main__ import Request, draw_all, read
from vlgs.gallery.draw import truth_of
from vlgs.opened import open_run
from vlgs.run import run
from vlgs.tables.benchmark import Benchmark
from vlgs.tables.gallery import FILE, FOLDER, GalleryView, read_gallery
from vlgs.tables.registry import Row, Table
from vlgs.types import IGNORE_ID, Camera, DenseLabels, ObjectLabels, Scene, View

OVERRIDES = (*TINY, "trainer=smoke", "trainer.iterations=8", "pictures=false")
COLOR = "<b>colour</b>/.."
"""A label that is no name of a file."""
TABLE = Table(
    "tiny",
    "Two rows",
    "synthetic",
    {},
    ("miou",),
    (
        Row(COLOR, ("indicator=opacity", "fusion=none")),
        Row("full", ()),
        Row("full again", ("fusion=self",)),
        Row("never run", ("seed=0", "fusion=cross")),
    ),
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with two runs of one scene, drawn once."""
    results = tmp_path_factory.mktemp("gallery")
    for row in TABLE.rows[:2]:
        assert run(composed(*OVERRIDES, *row.overrides, f"results={results}")) == 0
    benchmark = Benchmark("mine", ("data=synthetic", *OVERRIDES), ("glassware", "mirrors"), (0,))
    benchmark.extend(results / "mine" / "benchmark.yaml")
    draw_all(request_of(results))
    return results


@pytest.fixture
def results(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "results"))


def request_of(results: Path) -> Request:
    return Request(results, "*", TABLE, seed=0, scenes=(), threads=1, places={})


def pixels(results: Path, name: str) -> np.ndarray:
    with Image.open(results / "mine" / FOLDER / name) as image:
        return np.asarray(image.convert("RGB")).astype(float)


def views_of(results: Path) -> list[GalleryView]:
    return read_gallery(results / "mine")


def test_every_row_shows_its_own_render_and_its_own_answer(
    results: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.rmtree(results / "mine" / FOLDER)
    draw_all(request_of(results))
    said = capsys.readouterr().out
    assert "mine: glassware: 2 views by 2 rows" in said
    assert "mine: mirrors: no run folder of any row of tiny at seed 0; what is there stays" in said
    first, last = views_of(results)
    assert (first.place, last.place) == ("lowest", "highest")
    folders = {path.name: path for path in (results / "runs").iterdir()}
    for view in (first, last):
        assert [row.label for row in view.rows] == [COLOR, "full"]  # one run has one label
        assert (view.width, view.height) == (48, 36)
        for row in view.rows:
            metrics = json.loads((folders[row.run] / "metrics.json").read_text())
            assert row.psnr == metrics["per_view"][view.view]["psnr"]
            camera = next(c for c in open_run(folders[row.run]).held_out() if c.name == view.view)
            color = (
                open_run(folders[row.run]).field.render(camera.camera, frozenset({"color"})).color
            )
            assert color is not None
            want = (255 * color.clamp(0, 1)).round().numpy()
            assert np.abs(pixels(results, row.render) - want).mean() < 4  # JPEG
            queries = json.loads((folders[row.run] / "queries.json").read_text())
            ious = [
                one["iou"]
                for one in queries
                if (one["view"], one["category"], one["protocol"])
                == (view.view, view.word, view.protocol)
            ]
            assert [row.iou] == ious
        outlined, plain = pixels(results, view.outlined or ""), pixels(results, view.photograph)
        assert 0 < (np.abs(outlined - plain).max(axis=2) > 60).mean() < 0.2
    assert first.rows[0].psnr is not None
    assert last.rows[0].psnr is not None
    mean = [np.mean([row.psnr or 0 for row in view.rows]) for view in (first, last)]
    assert mean[0] <= mean[1]
    maps = [pixels(results, row.relevancy or "") for row in first.rows]
    assert np.abs(maps[0] - maps[1]).max() > 20


def test_what_was_drawn_stays_where_a_run_is_gone(
    results: Path, capsys: pytest.CaptureFixture[str]
):
    before = {path: path.read_bytes() for path in (results / "mine" / FOLDER).rglob("*.*")}
    shutil.rmtree(results / "runs" / views_of(results)[0].rows[1].run)
    stale = next(path for path in before if path.suffix == ".jpg").with_name("old.jpg")
    stale.write_bytes(b"")
    draw_all(request_of(results))
    assert (
        "glassware: no run folder of full at seed 0; what is there stays" in capsys.readouterr().out
    )
    assert before.items() <= {p: p.read_bytes() for p in (results / "mine" / FOLDER).rglob("*.*")}.items()  # fmt: skip
    (results / "mine" / FOLDER / FILE).unlink()
    draw_all(request_of(results))  # anew, of what there is
    assert "glassware: 2 views by 1 rows" in capsys.readouterr().out
    assert not stale.exists()


def test_a_damaged_field_is_named_and_nothing_is_half_written(results: Path):
    before = {path: path.read_bytes() for path in (results / "mine" / FOLDER).rglob("*.*")}
    field = results / "runs" / views_of(results)[0].rows[1].run / "field.safetensors"
    field.write_bytes(field.read_bytes()[:-40])
    with pytest.raises(ValueError, match=str(field)):
        draw_all(request_of(results))
    assert {p: p.read_bytes() for p in (results / "mine" / FOLDER).rglob("*.*")} == before


def test_truth_is_that_of_the_object_or_else_of_the_class():
    ids = torch.tensor([[0, 0, 1], [2, 2, IGNORE_ID]], dtype=torch.uint8)
    mug = torch.tensor([[True, False, False], [False, True, False]])
    view = View(
        "a",
        Camera(torch.eye(4), torch.eye(3), 3, 2),
        lambda: torch.zeros(2, 3, 3, dtype=torch.uint8),
        read_object_labels=lambda: ObjectLabels({"mug": mug}, {}),
        read_dense_labels=lambda: DenseLabels(ids),
    )
    nothing = torch.zeros(0, 3)
    scene = Scene("s", (), (view,), "all", nothing, nothing.byte(), nothing, nothing[:, 0], classes=("mug", "wall", "floor"))  # fmt: skip
    assert truth_of(view, scene, "mug").equal(mug)
    assert truth_of(view, scene, "wall").equal(ids == 1)
    with pytest.raises(
        ValueError, match="must be those that the runs were scored on, got none of 'lid'"
    ):
        truth_of(view, scene, "lid")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sed=1"], "gallery: arguments must be KEY=VALUE of .*, got sed"),
        (["seed=x"], "gallery: seed must be a whole number, got x"),
        (["seed"], "gallery: seed must be a whole number, got "),
        (["threads=0"], "gallery: threads must be 1 to"),
        (["tab=all"], "gallery: tab must be one table, got all"),
        (["tab=sistems"], "sistems"),
        (["data.scene=x"], "got data.scene"),
    ],
)
def test_a_wrong_argument_is_named(arguments: list[str], said: str):
    with pytest.raises(ValueError, match=said):
        read(arguments)


def test_arguments_are_read():
    got = read(["name=mine", "seed=3", "scenes=a, b", "tab=tab:levels", "data.root=/x y"])
    assert (got.name, got.seed, got.scenes, got.table.label) == ("mine", 3, ["a", "b"], "levels")
    assert got.places == {"root": "/x y"}


def test_a_benchmark_without_the_options_of_a_row_is_left(
    trained: Path, capsys: pytest.CaptureFixture[str]
):
    table = replace(TABLE, rows=(Row("odd", ("data.mist=1",)),))
    draw_all(replace(request_of(trained), table=table))
    assert "mine: left as it is, as a row of tiny has " in capsys.readouterr().out


def test_an_unknown_benchmark_or_scene_is_named(trained: Path, tmp_path: Path):
    with pytest.raises(ValueError, match="must hold a benchmark"):
        draw_all(request_of(tmp_path))
    with pytest.raises(ValueError, match=r"scenes must be of glassware, mirrors, got mirror$"):
        draw_all(Request(trained, "mine", TABLE, 0, ("mirror",), 1, {}))
