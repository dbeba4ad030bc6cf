"""`python -m vlgs.query` and `python -m vlgs.render`, as a user calls them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_runs import TINY, composed

from vlgs.fields import HasDepth
from vlgs.gaussians.ply import read_ply
from vlgs.opened import OpenedRun, open_run
from vlgs.opened.answers import ask_view, ranges, select_gaussians
from vlgs.query import main as query
from vlgs.render.__main__ import main as render
from vlgs.run import run
from vlgs.runs import RunFolder


def test_a_word_is_answered_in_pictures_and_json(
    finished: Path, opened: OpenedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    query([str(finished), "wooden table", "mug", "--json", "--out", str(tmp_path)])
    said = json.loads(capsys.readouterr().out)
    assert (said["words"], said["note"]) == (["wooden table", "mug"], "")
    answers = said["answers"]
    assert [row["word"] for row in answers] == ["wooden table"] * 2 + ["mug"] * 2
    assert answers[0]["score"] >= answers[1]["score"], "the best view first"
    asked = opened.ask(["wooden table", "mug"])
    cameras = {one.name: one.camera for one in opened.cameras("test")}
    bounds = ranges(opened.field, [*cameras.values()], asked)
    row = answers[0]
    found = ask_view(opened.field, cameras[row["view"]], asked)
    # Commands leave out the last step of the head: what is decoded here differs by rounding.
    off = 5e-6
    assert row["score"] == pytest.approx(found.score(0), abs=off)
    assert row["scores"] == {"3": row["score"]}
    x, y = row["peak"]
    highest = float(found.relevancy[0, 0].max())
    assert float(found.relevancy[0, 0, y, x]) == pytest.approx(highest, abs=off)
    mask = np.asarray(Image.open(row["files"]["mask"]))[..., 0] > 0
    above = found.relevancy[0, 0] - bounds[0].threshold()
    sure = (above.abs() > off).numpy()
    assert sure.mean() > 0.9
    assert (mask == (above > 0).numpy())[sure].all()
    assert row["share"] == pytest.approx(mask.mean())
    assert sorted(path.name.split("_")[-1] for path in (tmp_path / "mug").iterdir()) == sorted(
        ["heat.png", "mask.png", "overlay.png"] * 2
    )


def test_the_table_lists_views_and_can_do_without_pictures(
    finished: Path, opened: OpenedRun, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    train = opened.cameras("train")[0].name
    query([str(finished), "mug", "--views", f"test,{train}", "--no-pictures", "--threshold", "0.9"])
    said = capsys.readouterr().out
    assert train in said
    assert not (finished / "answers").exists()


def test_gaussians_that_answer_become_a_file(finished: Path, tmp_path: Path):
    path, opened = tmp_path / "table.ply", open_run(finished, within=0.0)  # as the command does
    query([str(finished), "wooden table", "--no-pictures", "--select", str(path), "--threshold", "0.2"])  # fmt: skip
    asked = opened.ask(["wooden table"])
    bounds = ranges(opened.field, [one.camera for one in opened.held_out()], asked)
    gaussians, chosen = select_gaussians(opened.field, asked, 0, bounds[0].threshold(0.2))
    cloud = gaussians.point_cloud([opened.cameras("train")[0].camera])
    assert 0 < chosen.sum() < len(chosen)
    assert torch.equal(read_ply(path)["means"], cloud.params["means"][chosen])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["mugg"], "did you mean 'mug'"),
        (["mug", "--threshold", "2"], "threshold must be 0 to 1"),
        (["mug", "--level", "1"], "level must be one of the run's, 3, got 1"),
        (["mug", "--views", "nowhere"], "must be train, test, orbit, a photograph's name"),
        (["mug", "--vocabulary", "nowhere.npz"], "vocabulary: file must exist"),
        (["mug", "--select", "out.obj"], "--select must end in .ply"),
        (["mug", "--threads", "0"], "threads must be 1 to"),
        (["mug", "--out", "{file}/below"], "Not a directory"),
    ],
)
def test_a_question_that_cannot_be_is_one_line(
    finished: Path, tmp_path: Path, arguments: list[str], message: str
):
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(SystemExit) as stopped:
        query([str(finished), *(a.format(file=file) for a in arguments)])
    assert str(stopped.value.code).startswith("error: ")
    assert message in str(stopped.value.code)
    assert "\n" not in str(stopped.value.code)


@pytest.mark.parametrize("formats", ["", ",", "gif"])
def test_a_format_that_is_none_is_one_line(finished: Path, formats: str, tmp_path: Path):
    with pytest.raises(SystemExit, match="render: format must be one of png"):
        render([str(finished), "--format", formats, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_numbers_and_pictures_of_every_output(finished: Path, opened: OpenedRun, tmp_path: Path):
    outputs = "color,alpha,depth,language,relevancy:mug"
    render([str(finished), "--outputs", outputs, "--format", "png,npy", "--out", str(tmp_path)])
    one = opened.cameras("test")[0]
    field = opened.field
    seen = field.render(one.camera, frozenset({"color", "alpha", "feature"}))
    assert seen.color is not None
    assert seen.alpha is not None
    assert seen.feature is not None
    assert isinstance(field, HasDepth)
    found = ask_view(field, one.camera, opened.ask(["mug"]))
    expected = {
        "color": seen.color.clamp(0, 1),
        "alpha": seen.alpha,
        "depth": field.depth(one.camera),
        "language": seen.feature[0],
        "relevancy_mug": found.relevancy[0, 0],
    }
    assert {path.name for path in tmp_path.iterdir()} == expected.keys()
    for name, values in expected.items():
        got = np.load(tmp_path / name / f"{one.name}.npy")
        np.testing.assert_allclose(got, values.numpy(), atol=1e-5)
        picture = np.asarray(Image.open(tmp_path / name / f"{one.name}.png"))
        assert picture.shape == (36, 48, 3)
    shown = np.asarray(Image.open(tmp_path / "color" / f"{one.name}.png")).astype(float)
    assert np.abs(shown / 255 - expected["color"].numpy()).max() < 0.51 / 255


def test_median_depth_and_another_size(finished: Path, opened: OpenedRun, tmp_path: Path):
    render([str(finished), "--outputs", "depth", "--depth", "median", "--size", "24x18", "--format", "npy", "--cameras", "orbit", "--frames", "2", "--out", str(tmp_path)])  # fmt: skip
    first, second = (np.load(path) for path in sorted((tmp_path / "depth").iterdir()))
    assert first.shape == (18, 24)
    assert (first > 0).mean() > 0.5
    assert not np.array_equal(first, second)


def test_a_video_plays_what_was_rendered(finished: Path, tmp_path: Path):
    av = pytest.importorskip("av")
    render([str(finished), "--cameras", "orbit", "--frames", "5", "--fps", "10", "--size", "47x35", "--format", "mp4,png", "--out", str(tmp_path)])  # fmt: skip
    with av.open(str(tmp_path / "color.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, float(stream.average_rate)) == ("h264", 10)
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 5
    for frame, path in zip(frames, sorted((tmp_path / "color").iterdir()), strict=True):
        assert frame.shape == (36, 48, 3), "odd sides are made even"
        error = frame[:35, :47].astype(float) - np.asarray(Image.open(path))
        assert 10 * np.log10(255**2 / (error**2).mean()) > 25


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--outputs", "sound"], "outputs must be some of color, alpha, depth, language, relevancy:WORD, got 'sound'"),
        (["--outputs", ""], "outputs must be at least one"),
        (["--outputs", "relevancy:mugg"], "did you mean 'mug'"),
        (["--format", "gif"], "format must be one of png, npy, mp4"),
        (["--size", "big"], "size must be WIDTHxHEIGHT"),
        (["--size", "0x5"], "width must be 1 to"),
        (["--fps", "0"], "fps must be"),
        (["--cameras", "nowhere"], "cameras: must be train, test, orbit"),
        (["--depth", "mode"], "depth must be one of expected, median"),
    ],
)  # fmt: skip
def test_what_cannot_be_rendered_is_one_line(
    finished: Path, tmp_path: Path, arguments: list[str], message: str
):
    with pytest.raises(SystemExit) as stopped:
        render([str(finished), "--out", str(tmp_path / "out"), *arguments])
    assert message in str(stopped.value.code)
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


def test_what_has_no_language_shows_colour_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert run(composed(*(o for o in TINY if not o.startswith("head.")), "method=gs3d", "trainer=smoke", "trainer.iterations=5", "pictures=false", f"results={tmp_path}")) == 0  # fmt: skip
    (folder,) = (tmp_path / "runs").iterdir()
    for call in (lambda: query([str(folder), "mug"]), lambda: render([str(folder), "--outputs", "language"])):  # fmt: skip
        with pytest.raises(SystemExit, match="error: "):
            call()
    render([str(folder), "--out", str(tmp_path / "seen")])
    assert len(list((tmp_path / "seen" / "color").iterdir())) == 2


def test_a_run_that_trains_says_how_far_it_is(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = RunFolder(Path(shutil.copytree(finished, tmp_path / "runs" / finished.name)))
    folder.field.unlink()
    query([str(folder.path), "mug", "--no-pictures"])
    assert "not finished, shown as of step 60" in capsys.readouterr().err
