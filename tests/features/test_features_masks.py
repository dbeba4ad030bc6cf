"""Masks and their suppression, against loops over pairs and pixels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vlgs.features.masks import Mask, crop_mask, intersections, paint, remove_small_regions
from vlgs.features.nms import MaskNms, box_nms

SIZE = (13, 17)


def random_masks(seed: int, count: int) -> list[Mask]:
    """Rectangles with ragged insides, some of them within others, some of them twice."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        if found and rng.random() < 0.2:
            found.append(found[rng.integers(len(found))])
            continue
        full = np.zeros(SIZE, bool)
        y, x = rng.integers(0, SIZE[0] - 1), rng.integers(0, SIZE[1] - 1)
        h, w = rng.integers(1, SIZE[0] - y + 1), rng.integers(1, SIZE[1] - x + 1)
        full[y : y + h, x : x + w] = rng.random((h, w)) < rng.choice([0.5, 1.0])
        mask = crop_mask(full)
        if mask is not None:
            found.append(mask)
    return found


def whole(mask: Mask) -> np.ndarray:
    full = np.zeros(SIZE, bool)
    full[mask.window] = mask.pixels
    return full


def test_a_mask_is_cut_to_its_box():
    full = np.zeros(SIZE, bool)
    full[3:5, 4:9] = True
    full[3, 4] = False
    mask = crop_mask(full, x=10, y=100)
    assert mask is not None
    assert mask.box == (14, 103, 19, 105)
    assert mask.area == 9
    assert crop_mask(np.zeros(SIZE, bool)) is None


def test_later_masks_are_painted_over_earlier_ones():
    below, above = Mask(0, 0, np.ones((3, 3), bool)), Mask(2, 1, np.array([[True], [True]]))
    expected = [[0, 0, 0, -1], [0, 0, 1, -1], [0, 0, 1, -1]]
    np.testing.assert_array_equal(paint([below, above], (3, 4)), expected)


@given(seed=st.integers(0, 1000), count=st.integers(0, 12))
@settings(max_examples=50, deadline=None)
def test_intersections_are_counts_of_common_pixels(seed: int, count: int):
    masks = random_masks(seed, count)
    want = [[(whole(a) & whole(b)).sum() for b in masks] for a in masks]
    np.testing.assert_array_equal(
        intersections(masks, SIZE), np.array(want).reshape(len(masks), len(masks))
    )


def iou(a: np.ndarray, b: np.ndarray) -> float:
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    both = np.prod(np.clip(high - low, 0, None))
    return both / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - both)


@given(seed=st.integers(0, 1000), count=st.integers(1, 20))
@settings(max_examples=50, deadline=None)
def test_box_nms_keeps_what_no_better_kept_box_overlaps(seed: int, count: int):
    rng = np.random.default_rng(seed)
    corner = rng.integers(0, 6, (count, 2))
    boxes = np.concatenate([corner, corner + rng.integers(1, 8, (count, 2))], axis=1)
    scores = rng.integers(0, 5, count) / 5  # many equal
    kept: list[int] = []
    for i in sorted(range(count), key=lambda i: (-scores[i], i)):
        if all(iou(boxes[i], boxes[k]) <= 0.5 for k in kept):
            kept.append(i)
    assert box_nms(boxes, scores, 0.5).tolist() == kept


def looped_nms(rule: MaskNms, masks: list[Mask], scores: np.ndarray) -> list[int]:
    """The rule of `MaskNms` pair by pair, without arrays; equal scores in order."""
    order = sorted(range(len(masks)), key=lambda i: (-scores[i], i))
    full = [whole(masks[i]) for i in order]
    n = len(order)
    overlapped, inner_of_better, inner_of_worse = [False] * n, [False] * n, [False] * n
    for i in range(n):
        for j in range(i + 1, n):
            common = (full[i] & full[j]).sum()
            of_i, of_j = common / full[i].sum(), common / full[j].sum()
            overlapped[j] |= common / (full[i] | full[j]).sum() > rule.iou
            removed = 1 - of_i * of_j > 1 - rule.inner
            inner_of_better[j] |= bool(of_i < 0.5 and of_j >= 0.85 and removed)
            inner_of_worse[i] |= bool(of_i >= 0.85 and of_j < 0.5 and removed)
    confident = [scores[i] > rule.score for i in order]
    free = [[not v for v in flags] for flags in (inner_of_better, inner_of_worse)]
    tests = [t if any(t) else [k < 3 for k in range(n)] for t in (confident, *free)]
    kept = [k for k in range(n) if not overlapped[k] and all(t[k] for t in tests)]
    return sorted(order[k] for k in kept)


@given(
    seed=st.integers(0, 1000),
    count=st.integers(0, 14),
    rule=st.builds(
        MaskNms, iou=st.sampled_from([0.3, 0.8]), score=st.sampled_from([0.0, 0.7, 2.0]),
        inner=st.sampled_from([0.2, 0.5, 0.0]),
    ),
)  # fmt: skip
@settings(max_examples=200, deadline=None)
def test_mask_nms_is_the_rule_pair_by_pair(seed: int, count: int, rule: MaskNms):
    masks = random_masks(seed, count)
    scores = np.random.default_rng(seed).integers(0, 10, len(masks)) / 10
    assert rule(masks, scores, SIZE).tolist() == looped_nms(rule, masks, scores)


def test_a_part_of_a_better_mask_goes_and_so_does_one_of_a_worse_mask():
    large, part = Mask(0, 0, np.ones((8, 8), bool)), Mask(2, 2, np.ones((3, 3), bool))
    for scores in ([0.9, 0.8], [0.8, 0.9]):
        assert MaskNms()([large, part], np.array(scores), SIZE).tolist() == [0]


def test_without_a_confident_mask_the_best_three_stay():
    masks = [Mask(4 * i, 0, np.ones((3, 3), bool)) for i in range(4)]
    assert MaskNms()(masks, np.array([0.1, 0.4, 0.3, 0.2]), SIZE).tolist() == [1, 2, 3]


@pytest.mark.parametrize("at", [(0, 0), (4, 6)])
def test_holes_are_filled_and_islands_go(at: tuple[int, int]):
    pixels = np.ones((7, 8), bool)
    pixels[2, 2] = False  # a hole
    pixels[:, 5] = False
    pixels[2:, 6:] = False  # what is left at the right is an island of 4
    mask = Mask(at[1], at[0], pixels)
    cleaned, changed = remove_small_regions(mask, (40, 40), least=5)
    assert changed
    assert cleaned.box == (at[1], at[0], at[1] + 5, at[0] + 7)
    assert cleaned.pixels.all()
    again, changed = remove_small_regions(cleaned, (40, 40), least=5)
    assert not changed
    assert again is cleaned


def test_a_bay_is_no_hole_and_the_largest_island_stays():
    pixels = np.ones((5, 5), bool)
    pixels[2, 0] = False  # open to the outside on the left
    _, changed = remove_small_regions(Mask(3, 3, pixels), (20, 20), least=4)
    assert not changed
    corner, _ = remove_small_regions(Mask(0, 3, pixels), (20, 20), least=4)
    assert corner.pixels.all()  # at the photograph's border it is closed
    islands = np.array([[True, True, False, True]])
    left, changed = remove_small_regions(Mask(5, 5, islands), (20, 20), least=9)
    assert changed
    assert left.box == (5, 5, 7, 6)
