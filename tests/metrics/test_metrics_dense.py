"""The dense protocol by hand and against torchmetrics."""

import pytest
import torch
from torchmetrics.functional.classification import multiclass_confusion_matrix

from vlgs.metrics.dense import Dense, class_counts, confusion, pooled_iou, predict_classes
from vlgs.metrics.mean import mean_of_known
from vlgs.metrics.protocol import Evidence
from vlgs.types import IGNORE_ID


def truth(*rows: list[int]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.uint8)


def names(counts: torch.Tensor) -> list[str]:
    return [f"class {i}" for i in range(len(counts))]


def class_iou(*views: torch.Tensor) -> list[float | None]:
    """Per class, over the confusions of all views."""
    scores = [s for counts in views for s in class_counts("v", counts, names(counts))]
    return list(pooled_iou(scores, names(views[0])).values())


def pixel_accuracy(counts: torch.Tensor) -> float | int | None:
    scores = class_counts("v", counts, names(counts))
    return Dense().conclude(scores, names(counts)).more["pixel_accuracy"]


def test_scores_by_hand():
    counts = confusion(torch.tensor([[0, 0, 1], [1, 1, 2]]), truth([0, 0, 0], [1, 1, IGNORE_ID]), 4)
    assert counts[:2, :2].tolist() == [[2, 1], [0, 2]]
    ious = class_iou(counts)
    assert ious == [
        pytest.approx(2 / 3),
        pytest.approx(2 / 3),
        None,
        None,
    ]  # 2 lies on a pixel to ignore
    assert mean_of_known(ious) == pytest.approx(2 / 3)
    assert pixel_accuracy(counts) == pytest.approx(4 / 5)


def test_predicted_but_absent_class_scores_zero():
    ious = class_iou(confusion(torch.tensor([[0, 1]]), truth([0, 0]), 3))
    assert ious == [0.5, 0.0, None]


def test_predicted_but_absent_class_can_be_skipped():
    counts = confusion(torch.tensor([[0, 1]]), truth([0, 0]), 3)
    scores = class_counts("v", counts, names(counts))
    assert list(pooled_iou(scores, names(counts), "skip").values()) == [0.5, None, None]
    zero, skip = (Dense(a).conclude(scores, names(counts)) for a in ("zero", "skip"))
    assert (zero.miou, skip.miou) == (0.25, 0.5)
    assert zero.more["miou_dense_present"] == 0.5


def seen(cosines: list[torch.Tensor], labels: torch.Tensor | None) -> Evidence:
    return Evidence("v", ("a", "b"), (), labels, cosines, cosines)


def test_levels_are_merged_by_their_largest_cosine():
    low = torch.tensor([[[0.1, 0.4]], [[0.3, 0.2]]])
    high = torch.tensor([[[0.5, 0.0]], [[0.0, 0.1]]])
    assert predict_classes([low]).tolist() == [[1, 0]]
    assert predict_classes([low, high]).tolist() == [[0, 0]]
    scores = Dense().score(seen([low, high], truth([0, 1])))
    assert [(s.category, s.both, s.selected, s.true) for s in scores] == [
        ("a", 1, 2, 1),
        ("b", 0, 0, 1),
    ]


def test_views_without_labels_and_nan_never_become_scores():
    cosines = torch.zeros(2, 1, 2)
    assert Dense().score(seen([cosines], None)) == []
    nothing = Dense().conclude([], ("a", "b"))
    assert (nothing.miou, nothing.loc_acc) == (None, None)
    assert set(nothing.reasons) == {"miou", "loc_acc"}
    cosines[1, 0, 1] = torch.nan
    with pytest.raises(ValueError, match="dense: relevancy of 'every class' must be finite"):
        Dense().score(seen([cosines], truth([0, 1])))


def test_agrees_with_torchmetrics():
    rng = torch.Generator().manual_seed(0)
    labels = torch.randint(0, 7, (40, 50), generator=rng).to(torch.uint8)
    labels[labels == 6] = IGNORE_ID
    prediction = torch.randint(0, 6, (40, 50), generator=rng)
    want = multiclass_confusion_matrix(prediction, labels.long(), 6, ignore_index=IGNORE_ID)
    assert torch.equal(confusion(prediction, labels, 6), want)


def test_pixels_are_counted_over_views_not_averaged_per_view():
    a = confusion(torch.tensor([[0, 0, 0, 0]]), truth([0, 0, 0, 0]), 2)
    b = confusion(torch.tensor([[1, 1]]), truth([0, 1]), 2)
    assert class_iou(a, b) == [pytest.approx(4 / 5), pytest.approx(1 / 2)]


def test_truth_as_prediction_scores_one_and_chance_is_chance():
    rng = torch.Generator().manual_seed(0)
    labels = torch.randint(0, 5, (200, 200), generator=rng).to(torch.uint8)
    assert class_iou(confusion(labels.long(), labels, 5)) == [1.0] * 5
    guess = torch.randint(0, 5, (200, 200), generator=rng)
    # two independent fair draws of 1/5: IoU = (1/25) / (2/5 - 1/25) = 1/9
    assert mean_of_known(class_iou(confusion(guess, labels, 5))) == pytest.approx(1 / 9, abs=0.01)


def test_nothing_labelled_is_not_available():
    counts = confusion(torch.tensor([[0, 1]]), truth([IGNORE_ID, IGNORE_ID]), 2)
    assert class_iou(counts) == [None, None]
    assert mean_of_known(class_iou(counts)) is None
    assert pixel_accuracy(counts) is None


def test_class_without_a_name_is_refused():
    with pytest.raises(ValueError, match=r"of the truth must be in 0\.\.1 or 255, got 0\.\.2"):
        confusion(torch.tensor([[0, 1]]), truth([0, 2]), 2)


def test_labels_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"as large as the view \[1, 2\], got \[1, 3\]"):
        confusion(torch.tensor([[0, 1]]), truth([0, 1, 1]), 2)


def test_prediction_is_the_largest_cosine():
    cosines = torch.tensor([[[0.1, 0.9]], [[0.2, 0.9]], [[0.1, -1.0]]])
    assert predict_classes([cosines]).tolist() == [[1, 0]]
