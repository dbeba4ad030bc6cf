"""Scores on a model whose answers are known."""

from dataclasses import replace

import pytest
import torch
from report_fakes import CLASSES, Drawing, FakeField, scene, view, vocabulary, with_test

from vlgs.fields.several import SeveralFields
from vlgs.metrics.dense import Dense
from vlgs.metrics.goi import Goi
from vlgs.metrics.lerf_ovs import LerfOvs
from vlgs.metrics.ovs3d import Ovs3dArgmax, Ovs3dThreshold
from vlgs.metrics.protocol import Auto, EvaluationProtocol
from vlgs.metrics.select3d import Select3d
from vlgs.queries import LerfRelevancy, VocabSoftmax
from vlgs.queries.text import VocabularyText
from vlgs.report.evaluate import Evaluation, evaluate, prompts_of
from vlgs.report.language import LanguageTally
from vlgs.types import IGNORE_ID, Camera, DenseLabels, ObjectLabels, Scene

AUTO = Auto()
OBJECTS = CLASSES[2:5]


def score(
    scene: Scene, noise: float = 0.0, protocol: EvaluationProtocol | Auto = AUTO
) -> Evaluation:
    return evaluate(
        FakeField(noise), scene, LerfRelevancy(), VocabularyText(scene.vocabulary), protocol
    )


def test_the_truth_scores_one():
    got = score(scene())
    assert got.protocol == "dense@1/synthetic"
    assert got.miou == 1
    assert got.loc_acc == 1
    assert got.per_category == dict.fromkeys(CLASSES[:5], 1.0) | {"absent": None}
    assert got.beside["pixel_accuracy"] == 1
    assert got.ssim == pytest.approx(1)
    assert got.psnr == torch.inf
    assert set(got.reasons) == {"lpips"}
    assert list(got.per_view) == ["view_00", "view_01", "view_02"]


def test_the_ceiling_is_what_exact_features_score():
    got = score(scene())  # the model's features are exact
    assert got.beside["miou_lerf_ovs_ceiling"] == pytest.approx(
        got.beside["miou_lerf_ovs"], abs=0.01
    )
    assert got.beside["loc_acc_lerf_ovs_ceiling"] == 1
    noisy = score(scene(), noise=1.0)
    assert noisy.beside["miou_lerf_ovs_ceiling"] == got.beside["miou_lerf_ovs_ceiling"]
    assert noisy.miou is not None
    assert noisy.miou < 0.9


def test_exact_features_are_those_of_the_true_class_and_none_where_there_is_no_class():
    encoded, _ = prompts_of(scene(1), LerfRelevancy(), VocabularyText(vocabulary()))
    assert encoded is not None
    truth = torch.tensor([[2, 0, IGNORE_ID]], dtype=torch.uint8)
    got = LanguageTally(LerfRelevancy(), encoded)._exact_relevancy(truth)
    want = LerfRelevancy()(encoded.text[[2, 0]], encoded.text, encoded.negatives)
    torch.testing.assert_close(got[:, 0, :2], want)
    assert (got[:, 0, 2] == 0.5).all()


def test_means_of_the_kinds_are_over_their_categories():
    got = score(scene(), noise=0.5)
    glass, steel = got.per_category["wine glass"], got.per_category["steel kettle"]
    assert glass is not None
    assert steel is not None
    assert got.beside["miou_translucent_reflective"] == pytest.approx((glass + steel) / 2)
    assert "miou_other" in got.beside


def test_object_labels_alone_give_lerf_ovs():
    got = score(scene(dense=False, objects=True))
    assert got.protocol == "lerf_ovs@1/synthetic"
    assert set(got.per_category) == set(OBJECTS)
    assert (got.beside["hits_lerf_ovs"], got.beside["units_lerf_ovs"]) == (9, 9)
    assert got.loc_acc == 1
    assert got.miou == got.beside["miou_lerf_ovs"]
    assert got.beside["miou_dense"] is None
    assert got.beside["miou_lerf_ovs_ceiling"] is None


def test_the_headline_can_be_chosen():
    both = scene(dense=True, objects=True)
    got = score(both, protocol=LerfOvs(strict=True))
    assert got.protocol == "lerf_ovs_strict@1/synthetic"
    assert got.miou == got.beside["miou_lerf_ovs"]
    assert got.beside["miou_dense"] == 1
    dense = score(scene(dense=False, objects=True), protocol=Dense())
    assert dense.miou is None
    assert dense.reasons["miou"] == "no held-out view has a class for any pixel"


def test_scene_without_labels_has_no_language_scores_and_says_why():
    got = score(scene(dense=False))
    assert (got.miou, got.loc_acc) == (None, None)
    assert got.reasons["miou"] == "no held-out view has a labelled object"
    assert got.ssim is not None


@pytest.mark.parametrize(
    ("text", "classes", "reason"),
    [
        (None, CLASSES, "no language was trained"),
        (VocabularyText(None), CLASSES, "the scene must bring a vocabulary"),
        (VocabularyText(vocabulary(CLASSES)), CLASSES, "query=vocab_softmax"),
        (VocabularyText(vocabulary()), (), "the scene has no labels"),
        (VocabularyText(vocabulary()), (*CLASSES, "zebra"), "got 'zebra'"),
    ],
)
def test_missing_words_cost_only_the_language_scores(
    text: VocabularyText | None, classes: tuple[str, ...], reason: str
):
    where = replace(scene(1), classes=classes)
    got = evaluate(FakeField(), where, LerfRelevancy(), text, AUTO)
    assert (got.miou, got.loc_acc, dict(got.per_category)) == (None, None, {})
    assert reason in got.reasons["miou"]
    assert got.ssim == pytest.approx(1)
    assert prompts_of(where, LerfRelevancy(), text) == (None, got.reasons["miou"])


def test_vocab_softmax_needs_no_negatives():
    got = evaluate(FakeField(), scene(1), VocabSoftmax(), VocabularyText(vocabulary(CLASSES)), AUTO)
    assert (got.miou, got.loc_acc) == (1, 1)


def test_no_held_out_view_scores_nothing():
    got = score(with_test(scene()))
    assert (got.psnr, got.ssim, got.miou, got.loc_acc) == (None, None, None, None)
    assert got.reasons["psnr"] == "there are no held-out views"


def test_views_that_were_trained_on_are_counted():
    some = scene()
    got = score(replace(some, train=some.test[:2]))
    assert (got.beside["test_views"], got.beside["test_views_seen"]) == (3, 2)


def test_pixels_outside_the_photograph_do_not_count():
    drawing = Drawing()
    valid = torch.ones(150, 200, dtype=torch.bool)
    valid[:, :60] = False
    wrong = drawing.ids.clone()
    wrong[:, :60] = 5
    black = drawing.image.clone()
    black[:, :60] = 0
    spoilt = replace(
        view(drawing, "spoilt"),
        read_image=lambda: black,
        read_dense_labels=lambda: DenseLabels(wrong),
        read_valid=lambda: valid,
    )
    got = score(with_test(scene(), spoilt))
    assert got.miou == 1
    assert got.per_category["absent"] is None
    assert got.per_view["spoilt"]["psnr"] == torch.inf


def test_empty_masks_are_reported_not_scored():
    drawing = Drawing()
    nothing = torch.zeros(150, 200, dtype=torch.bool)
    masks = {**drawing.objects.masks, "red apple": nothing}
    broken = replace(
        view(drawing, "broken", dense=False),
        read_object_labels=lambda: ObjectLabels(masks, drawing.objects.boxes),
    )
    got = score(with_test(scene(), broken))
    assert got.per_category["red apple"] is None
    assert got.reasons["labels"] == "empty masks were left out: red apple in broken"
    assert got.miou is not None


def test_labels_of_an_unknown_class_are_refused():
    masks = {"zebra": torch.ones(150, 200, dtype=torch.bool)}
    odd = replace(
        view(Drawing(), "odd", dense=False), read_object_labels=lambda: ObjectLabels(masks, {})
    )
    with pytest.raises(ValueError, match=r"labels of view 'odd' must be among .* got \['zebra'\]"):
        score(with_test(scene(), odd))


@pytest.mark.parametrize(
    ("protocol", "name"),
    [
        (Ovs3dArgmax(), "ovs3d_argmax@1/synthetic"),
        pytest.param(Ovs3dThreshold(), "ovs3d_threshold@1/synthetic", marks=pytest.mark.slow),
        (Goi(), "mipnerf360_goi@1/synthetic"),
        (LerfOvs(), "lerf_ovs@1/synthetic"),
    ],
)
def test_every_protocol_can_be_the_headline(protocol: EvaluationProtocol, name: str):
    got = score(scene(objects=True), protocol=protocol)
    assert got.protocol == name
    assert got.failure is None
    assert got.miou is not None
    assert got.miou > 0.6
    assert got.beside["miou_dense"] == 1
    assert got.beside["boundary_iou"] is not None
    assert ("loc_acc" in got.reasons) == (got.loc_acc is None)


class TwoGaussians(FakeField):
    """The kettle as one Gaussian and the apple as another; a silhouette is what has weight."""

    def opacities(self) -> torch.Tensor:
        return super().opacities()[:2]

    def language_weights(self) -> torch.Tensor:
        return torch.tensor([0.9, 0.8])

    def codes(self) -> torch.Tensor:
        return vocabulary(CLASSES).vectors[[3, 4]]

    def render_values(self, camera: Camera, values: torch.Tensor, weight: torch.Tensor):
        ids = self._drawing(camera).ids
        shown = [(ids == 3 + i).float()[..., None] * values[i] * weight[i] for i in (0, 1)]
        return shown[0] + shown[1]


def test_selection_in_3d_renders_the_selected_gaussians_alone():
    where = scene(objects=True)
    text = VocabularyText(where.vocabulary)
    got = evaluate(TwoGaussians(), where, VocabSoftmax(), text, Select3d("argmax"))
    # The glass has no Gaussian; the argmax over classes gives each of the others its own.
    want = {"wine glass": 0, "steel kettle": 1, "red apple": 1}
    assert got.per_category == want
    assert got.miou == pytest.approx(2 / 3)
    assert got.beside["acc25"] == pytest.approx(2 / 3)
    assert got.protocol == "select3d@1[rule=argmax]/synthetic"
    faint = evaluate(
        TwoGaussians(), where, VocabSoftmax(), text, Select3d("argmax", silhouette=0.85)
    )
    assert faint.per_category["red apple"] == 0  # its weight is 0.8


def test_three_levels_are_three_fields():
    where = scene(objects=True)
    text = VocabularyText(where.vocabulary)
    fields = [FakeField(5.0), FakeField(5.0), FakeField()]
    got = evaluate(SeveralFields(fields), where, LerfRelevancy(), text, LerfOvs())
    alone = evaluate(fields[0], where, LerfRelevancy(), text, LerfOvs())
    assert alone.psnr == got.psnr  # colour is that of the first
    assert alone.loc_acc is not None
    assert got.loc_acc is not None
    assert got.loc_acc >= alone.loc_acc
    rows = [row for row in got.queries if row["protocol"] == "lerf_ovs@1/synthetic"]
    assert {row["level"] for row in rows} <= {0, 1, 2}
    with pytest.raises(ValueError, match="at least one field, got none"):
        SeveralFields([])


def test_every_query_is_kept():
    got = score(scene(2, objects=True), noise=0.5)
    rows = [row for row in got.queries if row["protocol"] == "lerf_ovs@1/synthetic"]
    assert [(row["view"], row["category"]) for row in rows] == [
        (f"view_{i:02}", name) for i in range(2) for name in OBJECTS
    ]
    ious = [row["iou"] for row in rows]
    assert got.beside["miou_lerf_ovs"] == pytest.approx(sum(ious) / len(ious))  # type: ignore[arg-type]
    assert {row["kind"] for row in rows} == {"translucent_reflective", "other"}
    dense = [row for row in got.queries if row["protocol"] == "dense@1/synthetic"]
    for name in OBJECTS:  # counts are enough to make the pooled IoU again
        of = [row for row in dense if row["category"] == name]
        both, true, chosen = (
            sum(int(row[key]) for row in of)  # type: ignore[arg-type]
            for key in ("both_pixels", "true_pixels", "selected_pixels")
        )
        assert got.per_category[name] == pytest.approx(both / (true + chosen - both))


def test_scores_that_were_asked_for_and_are_not_there_are_a_failure():
    assert score(scene(dense=False)).failure is None  # nothing is labelled, and nothing was asked
    asked = score(scene(dense=False), protocol=LerfOvs())
    assert asked.miou is None
    assert asked.failure is not None
    assert "no held-out view has a labelled object" in asked.failure
    nothing = torch.full((150, 200), IGNORE_ID, dtype=torch.uint8)
    blank = replace(view(Drawing(), "blank"), read_dense_labels=lambda: DenseLabels(nothing))
    empty = score(with_test(scene(), blank))
    assert empty.miou is None
    assert empty.failure is not None
    assert "no held-out view has a class for any pixel" in empty.failure
