"""Counts of one query and Boundary IoU, by hand and against scipy."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from vlgs.metrics.masks import QueryScore, Unit, boundary_iou, by_category, compare, share_hit


def box(top: int, left: int, height: int, width: int, size: int = 100) -> torch.Tensor:
    mask = torch.zeros(size, size, dtype=torch.bool)
    mask[top : top + height, left : left + width] = True
    return mask


def test_counts_by_hand():
    score = compare("v", Unit("x", box(0, 0, 10, 10)), box(5, 0, 10, 10), hit=True, level=2)
    assert (score.both, score.selected, score.true, score.pixels) == (50, 100, 100, 10_000)
    assert score.iou == pytest.approx(50 / 150)
    assert score.precision == 0.5
    assert score.accuracy == pytest.approx(1 - 100 / 10_000)
    assert (score.hit, score.level) == (True, 2)


def test_empty_sets_are_not_available():
    nothing, some = box(0, 0, 0, 0), box(0, 0, 5, 5)
    absent = compare("v", Unit("x", nothing), some)
    assert (absent.iou, absent.precision, absent.accuracy, absent.boundary_iou) == (None,) * 4
    missed = compare("v", Unit("x", some), nothing)
    assert (missed.iou, missed.precision, missed.boundary_iou) == (0, None, 0)
    assert by_category([absent]) == {"x": None}
    assert share_hit([absent]) is None


def test_sizes_must_agree():
    with pytest.raises(ValueError, match=r"selection of 'x' must be \[100, 100\] like its mask"):
        compare("v", Unit("x", box(0, 0, 5, 5)), torch.zeros(5, 5, dtype=torch.bool))


def test_boundary_iou_by_hand():
    # Diagonal 141.4: the boundary is 3 px wide. Two 20x20 squares, 1 px apart, share of their frames of 3 px:
    truth, shifted = box(30, 30, 20, 20), box(30, 31, 20, 20)
    assert boundary_iou(truth, truth) == 1
    frame = 20 * 20 - 14 * 14
    # The frames overlap in the three rows above and below over 19 columns, and in two columns on each side over 14 rows.
    both = 2 * 3 * 19 + 2 * 2 * 14
    assert boundary_iou(shifted, truth) == pytest.approx(both / (2 * frame - both))
    assert boundary_iou(box(60, 60, 5, 5), truth) == 0


def test_boundary_iou_agrees_with_scipy():
    rng = np.random.default_rng(0)
    masks = [
        np.greater(np.asarray(ndimage.gaussian_filter(rng.random((90, 120)), 8)), 0.5)
        for _ in range(2)
    ]
    d = round(0.02 * float(np.hypot(90, 120)))
    edges = [
        m & np.logical_not(ndimage.binary_erosion(m, np.ones((3, 3)), iterations=d)) for m in masks
    ]
    want = (edges[0] & edges[1]).sum() / (edges[0] | edges[1]).sum()
    got = boundary_iou(torch.from_numpy(masks[0]), torch.from_numpy(masks[1]))
    assert got == pytest.approx(want, abs=1e-12)


def test_means_by_category():
    scores = [
        QueryScore("v", "a", both=1, selected=1, true=2, pixels=9),
        QueryScore("w", "a", both=1, selected=1, true=1, pixels=9),
        QueryScore("w", "b", both=0, selected=1, true=1, pixels=9, hit=True),
    ]
    assert by_category(scores) == {"a": 0.75, "b": 0}
    assert by_category(scores, lambda s: s.precision) == {"a": 1, "b": 0}
    assert share_hit(scores) == 1
