"""`python -m vlgs.export` from the shell: what it writes, and what it says where it cannot."""

import base64
import gzip
import hashlib
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch
from tiny_runs import TINY, composed
from two_balls import HOSTILE, THINGS, opened_scene, unfinished

from vlgs.export import Wanted, export
from vlgs.export.__main__ import main
from vlgs.export.content import Content, drawn, most_important
from vlgs.export.packed import pack
from vlgs.fields import PointCloud
from vlgs.fields.planes import PlaneField
from vlgs.formats import read_gaussians
from vlgs.opened import OpenedRun
from vlgs.opened.answers import ranges, select_gaussians
from vlgs.run import run
from vlgs.types import RasterConfig

SOURCES = Path(__file__).parents[2] / "vlgs" / "export" / "page"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of nine steps, with a checkpoint."""
    results = tmp_path_factory.mktemp("results")
    short = ("trainer=smoke", "trainer.iterations=9", "trainer.checkpoint_every=3")
    assert run(composed(*TINY, *short, "pictures=false", f"results={results}")) == 0
    (path,) = (results / "runs").iterdir()
    return path


@pytest.fixture
def opened(tmp_path: Path) -> OpenedRun:
    return opened_scene(tmp_path / "run")


def about(page: Path) -> dict:
    """What a page says of itself in JSON."""
    found = re.search(
        r'<script id="about" type="application/json">(.*?)</script>', page.read_text()
    )
    assert found is not None
    return json.loads(found[1])


def test_the_command_writes_all_its_formats(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for name in ("a.html", "a.ply", "a.compressed.ply", "a.splat"):
        main([str(trained), str(tmp_path / name)])
    said = capsys.readouterr().out
    count = len(read_gaussians(trained / "point_cloud.ply").params["means"])
    assert f"a.ply: {count:,} Gaussians as 3DGS PLY" in said
    assert "words: wine glass, glass of water" in said
    assert said.count("not kept: language features") == 3
    ours, theirs = (
        read_gaussians(p).params for p in (trained / "point_cloud.ply", tmp_path / "a.ply")
    )
    assert all(theirs[name].equal(ours[name]) for name in ("means", "sh0", "shN", "opacity_logits"))
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "a.compressed.ply",
        "a.html",
        "a.ply",
        "a.splat",
    ]


def test_an_unfinished_run_shows_its_last_checkpoint(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(trained, tmp_path / "run")
    for name in ("metrics.json", "field.safetensors"):
        (tmp_path / "run" / name).unlink()
    main([str(tmp_path / "run"), str(tmp_path / "a.html"), "--words", "mug"])
    assert "not finished, shown as of step 9" in capsys.readouterr().err
    assert "Training goes on: this is step 9." in (tmp_path / "a.html").read_text()


@pytest.mark.parametrize("far", [False, True])
def test_gaussians_say_what_was_subtracted(opened: OpenedRun, tmp_path: Path, far: bool):
    origin = (500_123.0, 5_412_345.5, 312.0) if far else (0.0, 0.0, 0.0)
    run = replace(opened, notes=replace(opened.notes, origin=origin))
    said = {name: export(run, tmp_path / name, Wanted()) for name in ("a.ply", "a.html")}
    line = "(500123, 5412345.5, 312) is subtracted from all positions"
    assert (line in said["a.ply"]) == far
    assert not any("subtracted" in one for one in said["a.html"]), "a page shows no coordinates"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{folder}", "{folder}/a.html"], "must be the folder of a run, with config.yaml in it"),
        (
            ["{run}", "{folder}/a.spz"],
            "OUT must end in .html, .ply, .compressed.ply, .splat, got a.spz",
        ),
        (["{run}", "{folder}/none/a.ply"], "OUT must be in a folder that exists"),
        (["{run}", "/proc/a.html"], "/proc/"),
        (["{run}", "{folder}/a.html", "--words", "mug,zebra"], "zebra"),
        (
            ["{run}", "{folder}/a.html", "--select", "mug"],
            "--select must go with a file of Gaussians",
        ),
        (["{run}", "{folder}/a.ply", "--words", "mug"], "--words must go with .html, got a.ply"),
        (
            ["{run}", "{folder}/a.ply", "--level", "2"],
            "level must be one of the run's, 3, got 2",
        ),
        (["{run}", "{folder}/a.html", "--most", "0"], "export: most must be at least 1, got 0"),
        (["{run}", "{folder}/a.html", "--vocabulary", "{folder}/none.npz"], "none.npz"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(
    trained: Path, tmp_path: Path, arguments: list[str], message: str
):
    with pytest.raises(SystemExit) as stopped:
        main([a.format(run=trained, folder=tmp_path) for a in arguments])
    text = str(stopped.value)
    assert text.startswith("error: ")
    assert message in text
    assert "\n" not in text
    assert list(tmp_path.iterdir()) == []


def test_a_field_without_gaussians_and_one_without_language(opened: OpenedRun, tmp_path: Path):
    fog = PlaneField(
        opened.field, torch.zeros(0, 4), []
    )  # asks Gaussians, and says of none that it has them
    object.__setattr__(opened, "field", fog)
    with pytest.raises(
        ValueError, match="must have Gaussians to be exported, got the field has no"
    ):
        export(opened, tmp_path / "a.ply", Wanted())
    mute = opened_scene(tmp_path / "run")
    mute.field.has_language = False  # type: ignore[misc]
    with pytest.raises(ValueError, match="cannot be asked for words"):
        export(mute, tmp_path / "a.html", Wanted(words=["table"]))
    assert list(tmp_path.iterdir()) == []
    lines = export(mute, tmp_path / "a.html", Wanted())
    assert lines[1:] == ["no words"]


def test_only_what_answers_is_selected(opened: OpenedRun, tmp_path: Path):
    lines = export(opened, tmp_path / "a.ply", Wanted(select="green ball"))
    asked, cameras = opened.ask(["green ball"]), [one.camera for one in opened.held_out()]
    threshold = ranges(opened.field, cameras, asked)[0].threshold()
    assert lines[1] == f"those that answer 'green ball', above a relevancy of {threshold:.3f}"
    _, chosen = select_gaussians(opened.field, asked, 0, threshold)
    means = read_gaussians(tmp_path / "a.ply").params["means"]
    assert means.equal(opened.field.model.splats["means"][chosen])  # type: ignore[attr-defined]
    assert 140 < len(means) <= 160
    assert (means[:, 0] > 0).all()


def test_what_nothing_draws_is_left_out_and_counted():
    params = {"means": torch.eye(3), "opacity_logits": torch.tensor([-20.0, 0, 3])}
    kept = drawn(Content(PointCloud(params, (), RasterConfig())))
    assert kept.cloud.params["means"].equal(torch.eye(3)[1:])
    assert kept.notes == ["1 of 3 Gaussians left out, which nothing draws"]
    assert drawn(kept).notes == kept.notes


def test_most_keeps_what_is_large_opaque_and_near(opened: OpenedRun):
    params = {
        "means": torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 400]]),
        # The third is a large needle, whose area is small; the last is large and far away.
        "log_scales": torch.tensor([[2.0, 2, 2], [0.01, 3, 3], [10, 0.1, 0.1], [9, 9, 9]]).log(),
        "opacity_logits": torch.tensor([0.9, 0.1, 0.9, 0.9]).logit(),
    }
    content = Content(PointCloud(params, (), RasterConfig()))
    kept = most_important(content, opened, 1)
    assert kept.cloud.params["means"].equal(params["means"][:1])
    assert kept.notes == ["1 of 4 Gaussians, those with the largest opacity times area"]
    # 0.9 x 4, 0.1 x 9, 0.9 x 1
    assert most_important(content, opened, 2).cloud.params[
        "opacity_logits"
    ].tolist() == pytest.approx(params["opacity_logits"][[0, 1]].tolist())


def test_numbers_are_rounded_by_half_a_step_at_most(opened: OpenedRun):
    params = dict(opened.field.model.splats)  # type: ignore[attr-defined]
    params = {name: value.detach().clone() for name, value in params.items()}
    params["means"][7] = torch.tensor([500.0, -3.0, 0.25])  # one at the horizon
    packed = pack(Content(PointCloud(params, (), RasterConfig())), torch.zeros(3), 4.0)
    said = packed.about
    planes = torch.frombuffer(bytearray(gzip.decompress(packed.data)), dtype=torch.uint8)
    planes = planes.view(-1, said["count"]).double()
    starts, at = {}, 0
    for name, count in said["columns"]:
        starts[name], at = at, at + count
    assert at == len(planes) == 6 + 3 + 4 + 3 + 1 + 45
    steps = 256 * planes[0:6:2] + planes[1:6:2]
    low, high = (torch.tensor(said["places"][k])[:, None] for k in ("low", "high"))
    folded = low + (high - low) * steps / 65535
    means = 4.0 * folded.sign() * folded.abs().expm1()
    error = torch.cdist(params["means"].double(), means.T).min(dim=1).values
    assert error[7] < 0.05
    assert error.max() - error[7] < 0.05
    assert error.median() < 3e-4  # of a scene that is four wide
    opacity = planes[starts["opacity"]] / 255
    assert (
        opacity.sort()[0] - params["opacity_logits"].sigmoid().double().sort()[0]
    ).abs().max() < 0.5 / 255 + 1e-6


class Markup(HTMLParser):
    """Elements of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)


def test_a_page_is_one_file_whatever_words_and_names_are_like(tmp_path: Path):
    plain, hostile = tmp_path / "plain.html", tmp_path / "hostile.html"
    export(opened_scene(tmp_path / "run"), plain, Wanted())
    export(
        unfinished(opened_scene(tmp_path / HOSTILE[:1], name=HOSTILE), 7),
        hostile,
        Wanted(words=[HOSTILE]),
    )
    texts = [path.read_text() for path in (plain, hostile)]
    tags = [Markup(text).tags for text in texts]
    assert tags[0] == tags[1]
    assert about(hostile)["words"][0]["name"] == HOSTILE
    for text in texts:
        assert not re.search(r"""(src|href)=["'](?!data:)""", text.replace(HOSTILE, ""))
        assert "http://" not in text
        assert "https://" not in text
        _, _, script = text.rpartition('<script type="module">')
        digest = hashlib.sha256(script.partition("</script>")[0].encode()).digest()
        digest = base64.b64encode(digest).decode()
        assert f"script-src 'sha256-{digest}'" in text


def test_the_page_stays_small(tmp_path: Path):
    assert sum(path.stat().st_size for path in SOURCES.iterdir()) < 60_000
    opened = opened_scene(tmp_path / "run")
    model = opened.field.model  # type: ignore[attr-defined]
    copies = -(-50_000 // model.count)
    generator = torch.Generator().manual_seed(0)
    for name, value in model.splats.items():
        many = value.repeat(copies, *[1] * (value.dim() - 1))[:50_000]
        noise = 0.1 * torch.randn(many.shape, generator=generator)
        model.splats[name] = torch.nn.Parameter(many + noise, requires_grad=False)
    export(opened, tmp_path / "a.html", Wanted(words=THINGS))
    assert (tmp_path / "a.html").stat().st_size <= 3_000_000
