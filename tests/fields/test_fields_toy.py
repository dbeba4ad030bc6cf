"""A field that is a formula goes the whole way: scores, pictures, frame rates, tables. It has no Gaussians and no parameters."""

import ast
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vlgs.fields import (
    NO_GAUSSIANS,
    Field,
    FieldImages,
    faster,
    gaussians_of,
    require_outputs,
)
from vlgs.fields.cloud import write_point_cloud
from vlgs.fields.several import SeveralFields
from vlgs.metrics.protocol import Auto, EvaluationProtocol
from vlgs.metrics.select3d import Select3d
from vlgs.queries import LerfRelevancy
from vlgs.queries.text import VocabularyText
from vlgs.report.evaluate import Evaluation, evaluate, prompts_of
from vlgs.report.pictures import write_pictures
from vlgs.report.results import write_metrics
from vlgs.report.timing import measure_fps
from vlgs.report.words import questions_of
from vlgs.tables.__main__ import main as tables
from vlgs.types import Camera, DenseLabels, Scene, View, Vocabulary

CLASSES = ("sky", "ball")
COLORS = torch.tensor([[0.2, 0.4, 0.8], [0.8, 0.2, 0.2]])
VOCABULARY = Vocabulary((*CLASSES, *LerfRelevancy().negatives), torch.eye(6))
QUERY, TEXT = LerfRelevancy(), VocabularyText(VOCABULARY)


class Ball:
    """A red ball before a blue sky: all that is seen is a function of the direction in which one looks."""

    outputs = frozenset({"color"})
    has_language = True

    def levels(self) -> Sequence[Field]:
        return (self,)

    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        require_outputs("ball", outputs, self.outputs)
        return FieldImages(color=COLORS[hit(camera).long()])

    def similarity(
        self,
        camera: Camera,
        words: Float[Tensor, "k e"],
        seen: FieldImages | None = None,
        pixels: Int[Tensor, " p"] | None = None,
    ) -> Float[Tensor, "levels k h w"]:
        at = VOCABULARY.vectors[hit(camera).long()] @ words.T
        found = at.movedim(-1, 0)[None]
        return found if pixels is None else found.flatten(2)[:, :, None, pixels]


def hit(camera: Camera) -> Bool[Tensor, "h w"]:
    """Whether the ray of each pixel meets the unit ball at the origin."""
    y, x = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ camera.K.inverse().T
    rays = torch.nn.functional.normalize(rays, dim=-1)
    ball = camera.viewmat[:3, 3]
    along = rays @ ball
    return (ball @ ball - along.square() < 1) & (along > 0)


def view(name: str, shift: float) -> View:
    K, viewmat = torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), torch.eye(4)
    viewmat[:3, 3] = torch.tensor([shift, 0, 4])
    camera = Camera(viewmat, K, 40, 30)
    ids = hit(camera).to(torch.uint8)
    image = (COLORS[ids.long()] * 255).round().to(torch.uint8)
    return View(name, camera, read_image=lambda: image, read_dense_labels=lambda: DenseLabels(ids))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(
        name="ball",
        train=(view("a", -0.5),),
        test=(view("b", 0.0), view("c", 0.6)),
        split="synthetic",
        points=torch.zeros(0, 3),
        point_colors=torch.zeros(0, 3, dtype=torch.uint8),
        mask_vectors=torch.eye(2, 6),
        mask_areas=torch.ones(2),
        classes=CLASSES,
        vocabulary=VOCABULARY,
    )


def score(scene: Scene, protocol: EvaluationProtocol | Auto) -> Evaluation:
    return evaluate(Ball(), scene, QUERY, TEXT, protocol)


def test_what_knows_no_faster_way_stays_itself():
    ball = Ball()
    assert faster(ball, 0.1) is ball


def test_it_is_a_field_and_has_no_gaussians(tmp_path: Path):
    assert isinstance(Ball(), Field)
    assert gaussians_of(Ball()) is None
    assert not write_point_cloud(tmp_path / "point_cloud.ply", Ball(), [view("a", 0).camera])
    assert not list(tmp_path.iterdir())


def test_an_output_that_cannot_be_had_is_refused_by_name():
    camera = view("a", 0).camera
    with pytest.raises(ValueError, match="ball: outputs must be some of color, got depth, feature"):
        Ball().render(camera, frozenset({"color", "feature", "depth"}))
    with pytest.raises(ValueError, match="ball: outputs must be some of color, got none"):
        Ball().render(camera, frozenset())


def test_the_whole_way_from_scores_to_a_table(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    evaluation = score(scene, Auto())
    assert (evaluation.miou, evaluation.loc_acc, evaluation.failure) == (1, 1, None)
    assert evaluation.psnr is not None
    assert evaluation.psnr > 50  # of colours that were rounded to 8 bits
    assert evaluation.indicator is None
    assert evaluation.reasons["indicator"] == NO_GAUSSIANS
    run = tmp_path / "runs" / "ball"
    overview = write_pictures(
        run / "renders", Ball(), scene, QUERY, prompts_of(scene, QUERY, TEXT)[0]
    )
    assert overview is not None
    assert overview.is_file()
    drawn = {path.stem for path in (run / "renders" / "b").iterdir()}
    assert {"photograph", "render", "labels", "prediction", "relevancy_ball"} <= drawn
    assert not drawn & {"features", "indicator_minus_opacity"}
    asked = questions_of(Ball(), scene, QUERY, TEXT)
    assert asked is not None
    timing = measure_fps(
        Ball(), [view.camera for view in scene.test], QUERY, asked.prompts, repeats=3
    )
    assert timing.fps_query is not None
    assert timing.fps_language is None  # it has no language apart from its answers
    extra = {"fps_color": timing.fps_color, "config_hash": "ball", "recipe": "formula"}
    extra |= {"data_recipe": "formula", "dataset": "formula", "scene": scene.name, "seed": 0}
    extra |= {"results_version": 1, "n_gaussians": None, "ply_bytes": None}
    write_metrics(run / "metrics.json", evaluation, extra)
    assert json.loads((run / "metrics.json").read_text())["indicator"] is None
    monkeypatch.setattr(sys, "argv", ["tables", str(tmp_path), f"write={tmp_path / 'runs.csv'}"])
    tables()
    head, row = (tmp_path / "runs.csv").read_text().splitlines()
    assert dict(zip(head.split(","), row.split(","), strict=True))["mIoU %"] == "100.0"
    assert "ball" in capsys.readouterr().out


def test_what_asks_for_gaussians_is_not_available_and_says_why(scene: Scene):
    evaluation = score(scene, Select3d())
    why = "select3d selects Gaussians, and the field has none"
    assert (evaluation.miou, evaluation.loc_acc) == (None, None)
    assert evaluation.reasons["miou"] == evaluation.reasons["loc_acc"] == why
    assert evaluation.failure == f"select3d@1/synthetic: nothing could be scored, {why}"
    assert evaluation.beside["miou_dense"] == 1  # the protocols beside it go by pixels


def test_several_fields_answer_level_by_level(scene: Scene):
    class Foggy(Ball):
        def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
            color = super().render(camera, outputs).color
            assert color is not None
            return FieldImages(color=color / 2)

    both, camera = SeveralFields([Ball(), Foggy()]), scene.test[0].camera
    assert len(both.levels()) == 2
    assert torch.equal(
        both.render(camera, frozenset({"color"})).color,  # type: ignore[arg-type]
        Ball().render(camera, frozenset({"color"})).color,  # type: ignore[arg-type]
    )
    assert both.similarity(camera, VOCABULARY.vectors).shape == (2, 6, 30, 40)
    got = evaluate(both, scene, QUERY, TEXT, Auto())
    assert (got.miou, got.psnr) == (1, score(scene, Auto()).psnr)


def test_evaluation_imports_nothing_of_gaussians():
    """As the contract of import-linter in pyproject.toml does, without an installed package; a command stands above its library."""
    package = Path(str(sys.modules["vlgs"].__file__)).parent
    hidden = ("vlgs.gaussians", "vlgs.fusion", "vlgs.indicator", "vlgs.heads", "vlgs.fields.splat", "vlgs.fields.trained")  # fmt: skip
    for folder in ("report", "metrics", "query"):
        for path in set((package / folder).glob("*.py")) - {package / folder / "__main__.py"}:
            for node in ast.walk(ast.parse(path.read_text())):
                named = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                assert not [name for name in named if name.startswith(hidden)], path.name
