"""LERF-OVS: hand-worked units, and an independent slow loop that takes the steps of LangSplat's script one by one."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from slow import with_slow

from vlgs.metrics.lerf_ovs import LerfOvs, localise, score_unit
from vlgs.metrics.masks import QueryScore, Unit, intersection_over_union
from vlgs.metrics.protocol import Evidence, Figures, query_figures
from vlgs.metrics.segment import LANGSPLAT, LANGSPLAT_V2, Constants, segment
from vlgs.metrics.smooth import box_mean, erode, majority_vote, pool_mean, pool_vote


def square(h: int, w: int, top: int, left: int, size: int) -> torch.Tensor:
    mask = torch.zeros(h, w, dtype=torch.bool)
    mask[top : top + size, left : left + size] = True
    return mask


def mirrored(i: int, n: int) -> int:
    """Index reflected at the borders without repeating them."""
    while n > 1 and not 0 <= i < n:
        i = -i if i < 0 else 2 * (n - 1) - i
    return i if n > 1 else 0


def slow_box_mean(image: np.ndarray, size: int) -> np.ndarray:
    h, w = image.shape
    out = np.zeros((h, w))
    for y in range(h):
        for x in range(w):
            window = [
                image[mirrored(y + dy, h), mirrored(x + dx, w)]
                for dy in range(-(size // 2), size - size // 2)
                for dx in range(-(size // 2), size - size // 2)
            ]
            out[y, x] = sum(window) / size**2
    return out.astype(image.dtype)


def slow_vote(mask: np.ndarray) -> np.ndarray:
    h, w = mask.shape
    out = np.zeros_like(mask)
    for y in range(h):
        for x in range(w):
            votes = [
                mask[j, i]
                for j in range(max(0, y - 3), min(y + 4, h - 1))
                for i in range(max(0, x - 3), min(x + 4, w - 1))
            ]
            out[y, x] = votes.count(True) > votes.count(False)
    return out


def slow_unit(levels: np.ndarray, mask: np.ndarray, boxes: np.ndarray) -> tuple[float, bool]:
    smooth = [slow_box_mean(level, 30) for level in levels]
    blended = [(a + r) / 2 for a, r in zip(smooth, levels, strict=True)]
    chosen = blended[int(np.argmax([m.max() for m in blended]))]
    n = (chosen - chosen.min()) / ((chosen - chosen.min()).max() + 1e-9)
    prediction = slow_vote(np.clip(2 * n - 1, 0, 1) > 0.4)
    iou = (prediction & mask).sum() / (prediction | mask).sum()
    best = smooth[int(np.argmax([a.max() for a in smooth]))]
    peaks = np.argwhere(best == best.max())
    hit = any(
        min(x1, x2) <= x <= max(x1, x2) and min(y1, y2) <= y <= max(y1, y2)
        for y, x in peaks
        for x1, y1, x2, y2 in boxes
    )
    return float(iou), bool(hit)


@pytest.mark.parametrize("seed", with_slow(range(4), (1, 2, 3)))
@pytest.mark.parametrize("levels", [1, 2])
def test_unit_agrees_with_the_slow_loop(seed: int, levels: int):
    rng = np.random.default_rng(seed)
    relevancy = ndimage.gaussian_filter(rng.random((levels, 35, 38), dtype=np.float32), (0, 5, 5))
    mask = relevancy[0] > np.quantile(relevancy[0], 0.8)
    boxes = rng.integers(0, 35, (2, 4)).astype(np.float32)
    unit = Unit("x", torch.from_numpy(mask), torch.from_numpy(boxes))
    got = score_unit(torch.from_numpy(relevancy), unit)
    want = slow_unit(relevancy, mask, boxes)
    assert got.iou == pytest.approx(want[0], abs=1e-12)
    assert got.hit is want[1]


@settings(max_examples=30, deadline=None)
@given(h=st.integers(1, 9), w=st.integers(1, 9), size=st.integers(1, 30), seed=st.integers(0, 99))
def test_box_mean_of_windows_larger_than_the_map(h: int, w: int, size: int, seed: int):
    image = np.random.default_rng(seed).random((h, w))
    got = box_mean(torch.from_numpy(image)[None], size)[0].numpy()
    np.testing.assert_allclose(got, slow_box_mean(image, size), atol=1e-12)


def test_box_mean_agrees_with_scipy_on_a_large_map():
    image = np.random.default_rng(0).random((90, 121))
    # scipy centres an even window on -size/2 .. size/2 - 1 as well; its mirror does not repeat the edge.
    want = ndimage.uniform_filter(image, 30, mode="mirror")
    got = box_mean(torch.from_numpy(image)[None], 30)[0].numpy()
    np.testing.assert_allclose(got, want, atol=1e-12)


def test_box_mean_window_reaches_one_pixel_further_up_and_left():
    image = torch.zeros(1, 80, 80)
    image[0, 40, 40] = 900
    y, x = torch.nonzero(box_mean(image, 30)[0], as_tuple=True)
    # a pixel p averages p - 15 .. p + 14, so the spot reaches p = 26 .. 55
    assert (y.min().item(), y.max().item(), x.min().item(), x.max().item()) == (26, 55, 26, 55)


def test_box_mean_keeps_the_ties_of_a_constant_map():
    smooth = box_mean(torch.full((1, 730, 988), 0.3), 30)
    assert (smooth == smooth[0, 0, 0]).all()


@settings(max_examples=50, deadline=None)
@given(h=st.integers(1, 12), w=st.integers(1, 12), seed=st.integers(0, 999))
def test_vote_agrees_with_the_slow_loop(h: int, w: int, seed: int):
    mask = np.random.default_rng(seed).random((h, w)) > 0.5
    assert np.array_equal(majority_vote(torch.from_numpy(mask), 7).numpy(), slow_vote(mask))


def test_last_row_and_column_never_vote():
    mask = torch.zeros(10, 10, dtype=torch.bool)
    mask[-1], mask[:, -1] = True, True
    assert not majority_vote(mask, 7).any()


def test_vote_breaks_ties_to_false():
    mask = torch.zeros(3, 3, dtype=torch.bool)
    mask[0, :2] = True  # the 2x2 voters of every window: two of four
    assert not majority_vote(mask, 7).any()


def test_threshold_keeps_the_top_three_tenths_of_the_range():
    ramp = torch.linspace(0, 1, 101).expand(101, 101).double()
    got = segment(ramp, Constants(vote=1))
    # vote=1 lets each pixel decide for itself, except for the last row and column, which have no vote
    assert torch.equal(got[50, :-1], torch.arange(100) > 70)
    assert not got[-1].any()


def test_truth_as_relevancy_scores_high_and_hits():
    mask = square(200, 200, 60, 70, 80)
    unit = Unit("x", mask, torch.tensor([[70.0, 60.0, 149.0, 139.0]]))
    score = score_unit(mask.double()[None], unit)
    assert score.iou is not None
    assert score.iou > 0.95  # smoothing and voting round the corners off
    assert score.hit
    assert score_unit(mask.double()[None], unit, strict=True).hit


def test_noise_scores_at_chance():
    rng = torch.Generator().manual_seed(0)
    mask = square(120, 120, 0, 0, 60)  # a quarter of the map
    scores = [
        score_unit(torch.rand(1, 120, 120, generator=rng), Unit("x", mask), strict=True)
        for _ in range(60)
    ]
    result = query_figures(scores)
    assert result.miou is not None
    assert result.miou < 0.25
    assert result.loc_acc == pytest.approx(0.25, abs=0.17)  # three standard deviations of 60 draws


def test_constant_map_hits_as_released_but_not_strictly():
    unit = Unit("x", square(50, 50, 0, 0, 5), torch.tensor([[0.0, 0.0, 4.0, 4.0]]))
    relevancy = torch.full((1, 50, 50), 0.3)
    released = score_unit(relevancy, unit)
    assert (released.iou, released.hit) == (0.0, True)
    strict = score_unit(relevancy, unit, strict=True)
    assert (strict.iou, strict.hit) == (0.0, False)


def test_strict_looks_at_the_first_maximum_only():
    smooth = torch.zeros(20, 20)
    smooth[3, 4] = smooth[12, 13] = 1
    second = Unit("x", square(20, 20, 12, 13, 1), torch.tensor([[13.0, 12.0, 13.0, 12.0]]))
    assert localise(smooth, second) is True
    assert localise(smooth, second, strict=True) is False
    first = Unit("x", second.mask, torch.tensor([[4.0, 3.0, 4.0, 3.0]]))
    assert localise(smooth, first, strict=True) is True


@pytest.mark.parametrize(
    ("box", "hit"),
    [
        ((4, 3, 9, 9), True),
        ((0, 0, 4, 3), True),
        ((9, 9, 4, 3), True),  # corners in any order
        ((4.5, 3, 9, 9), False),
        ((0, 0, 4, 2.5), False),
    ],
)
def test_box_edges_are_inclusive(box: tuple[float, ...], hit: bool):
    smooth = torch.zeros(20, 20)
    smooth[3, 4] = 1
    unit = Unit("x", square(20, 20, 0, 0, 1), torch.tensor([[15.0, 15, 16, 16], list(box)]))
    assert localise(smooth, unit) is hit


def test_unit_without_boxes_is_hit_in_its_mask():
    smooth = torch.zeros(20, 20)
    smooth[3, 4] = 1
    assert localise(smooth, Unit("x", square(20, 20, 3, 4, 2))) is True
    assert localise(smooth, Unit("x", square(20, 20, 4, 5, 2))) is False
    assert localise(smooth, Unit("x", square(20, 20, 0, 0, 0))) is None


def test_level_is_the_one_with_the_largest_smoothed_value():
    wide, narrow = square(100, 100, 10, 10, 40), square(100, 100, 70, 70, 6)
    # 0.5 over 40 pixels outlives the smoothing; 0.9 over 6 pixels does not in localisation, but does in the blend:
    # (0.9 + 0.9 * 36 / 900) / 2 = 0.468 against (0.5 + 0.5) / 2 = 0.5.
    levels = torch.stack([0.9 * narrow.double(), 0.5 * wide.double()])
    score = score_unit(levels, Unit("x", wide))
    assert score.iou is not None
    assert score.iou > 0.8
    assert score.hit
    # Raised to 1.0 the narrow one wins the segmentation, (1 + 0.04) / 2 = 0.52, and still not the localisation.
    levels[0] /= 0.9
    score = score_unit(levels, Unit("x", wide))
    assert score.iou == 0.0
    assert score.hit


def scored(category: str, both: int, true: int, hit: bool | None = None) -> QueryScore:
    """A query that selects nothing wrong: its IoU is both / true."""
    return QueryScore("view", category, both=both, selected=both, true=true, pixels=100, hit=hit)


def test_scene_means_are_over_queries_and_say_what_is_missing():
    scores = [
        scored("a", 2, 10, True),
        scored("a", 4, 10, False),
        scored("b", 9, 10, True),
        scored("c", 0, 0),
    ]
    result = query_figures(scores)
    assert result.miou == pytest.approx(0.5)
    assert (result.more["hits"], result.more["units"]) == (2, 3)
    assert result.loc_acc == pytest.approx(2 / 3)
    assert result.per_category == {"a": pytest.approx(0.3), "b": 0.9, "c": None}
    assert result.reasons == {"labels": "empty masks were left out: c in view"}


def test_no_queries_score_nothing():
    result = query_figures([])
    assert (result.miou, result.loc_acc, result.more["boundary_iou"]) == (None, None, None)
    assert result.reasons["miou"] == "no held-out view has a labelled object"


def test_iou_of_empty_sets():
    empty, full = torch.zeros(3, 3, dtype=torch.bool), torch.ones(3, 3, dtype=torch.bool)
    assert intersection_over_union(full, empty) is None
    assert intersection_over_union(empty, empty) is None
    assert intersection_over_union(empty, full) == 0
    assert intersection_over_union(full, full) == 1


def test_no_level_and_wrong_sizes_are_refused():
    unit = Unit("x", square(5, 5, 0, 0, 2))
    with pytest.raises(ValueError, match="at one level or more, got none"):
        score_unit(torch.zeros(0, 5, 5), unit)
    with pytest.raises(ValueError, match=r"must be \[5, 5\] like its mask, got \[5, 6\]"):
        score_unit(torch.zeros(1, 5, 6), unit)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_relevancy_is_refused(bad: float):
    relevancy = torch.zeros(1, 5, 5)
    relevancy[0, 2, 2] = bad
    with pytest.raises(ValueError, match="must be finite"):
        score_unit(relevancy, Unit("x", square(5, 5, 0, 0, 2)))


def test_constants_are_the_published_ones():
    assert Constants("filter2d", 30, 0.5, True, 0.4, 7, "clipped") == LANGSPLAT
    assert Constants("pool", 29, 0.5, True, 0.4, 7, "full") == LANGSPLAT_V2


@pytest.mark.parametrize(
    ("row", "size", "want"),
    [
        # OpenCV: anchor size // 2, border 101. Even windows reach one further to the left.
        ([1, 2, 3, 4, 5], 4, [2, 2, 2.5, 3.5, 4]),
        ([1, 2, 3, 4, 5], 2, [1.5, 1.5, 2.5, 3.5, 4.5]),
        ([1, 2, 3, 4, 5], 3, [5 / 3, 2, 3, 4, 13 / 3]),
        ([6, 0, 0, 0, 0, 0], 6, [1, 1, 1, 1, 0, 0]),
    ],
)
def test_box_mean_is_filter2d_by_hand(row: list[float], size: int, want: list[float]):
    along_x = torch.tensor([[row]], dtype=torch.float64).expand(1, 3, -1)
    torch.testing.assert_close(box_mean(along_x, size)[0, 1], torch.tensor(want).double())
    along_y = box_mean(along_x.mT.contiguous(), size)[0, :, 1]
    torch.testing.assert_close(along_y, torch.tensor(want).double())


def test_pool_mean_counts_no_cell_outside_by_hand():
    row = torch.tensor([[[1.0, 2, 3, 4, 5]]])
    assert pool_mean(row, 3)[0, 0].tolist() == [1.5, 2, 3, 4, 4.5]


def test_pool_mean_agrees_with_torch():
    rng = torch.Generator().manual_seed(0)
    maps = torch.rand(2, 33, 40, generator=rng, dtype=torch.float64)
    want = torch.nn.functional.avg_pool2d(maps, 7, 1, 3, count_include_pad=False)
    torch.testing.assert_close(pool_mean(maps, 7), want, atol=1e-12, rtol=0)


def test_pool_vote_lets_the_last_row_vote():
    mask = torch.zeros(10, 10, dtype=torch.bool)
    mask[6:] = True
    assert pool_vote(mask, 7)[-1].all()
    assert not pool_vote(mask, 7)[5].any()  # rows 2..8: three of seven
    assert pool_vote(mask, 7)[6].all()  # rows 3..9: four of seven


@settings(max_examples=30, deadline=None)
@given(h=st.integers(1, 12), w=st.integers(1, 12), d=st.integers(1, 3), seed=st.integers(0, 99))
def test_erosion_agrees_with_scipy(h: int, w: int, d: int, seed: int):
    mask = np.random.default_rng(seed).random((h, w)) > 0.2
    want = ndimage.binary_erosion(mask, np.ones((2 * d + 1, 2 * d + 1)))
    assert np.array_equal(erode(torch.from_numpy(mask), d).numpy(), want)


def test_without_the_stretch_the_threshold_is_that_of_the_normalised_map():
    ramp = torch.linspace(0, 1, 101).expand(101, 101).double()
    got = segment(ramp, Constants(vote=1, stretch=False))
    assert torch.equal(got[50, :-1], torch.arange(100) > 40)


@pytest.mark.parametrize("bad", [{"box": 0}, {"window": "pool"}, {"vote": 4}, {"threshold": 1.0}])
def test_bad_constants_are_refused(bad: dict[str, object]):
    with pytest.raises(ValueError, match=r"^protocol: "):
        Constants(**bad)  # type: ignore[arg-type]


def evidence(relevancy: torch.Tensor, *units: Unit) -> Evidence:
    """One class per unit, levels first."""
    names = tuple(unit.category for unit in units)
    return Evidence("v", names, units, None, list(relevancy), list(relevancy))


def strict_and_released(seen: Evidence) -> tuple[Figures, Figures]:
    protocols = LerfOvs(strict=True), LerfOvs()
    strict, released = (p.conclude(p.score(seen), seen.classes) for p in protocols)
    return strict, released


def test_three_levels_are_chosen_per_query():
    wide, narrow = square(100, 100, 10, 10, 40), square(100, 100, 55, 55, 40)
    levels = torch.zeros(3, 2, 100, 100)
    levels[0, 0], levels[2, 0] = 0.5 * narrow, 0.9 * wide
    levels[0, 1], levels[1, 1] = 0.3 * wide, 0.8 * narrow
    seen = evidence(levels, Unit("wide", wide), Unit("narrow", narrow))
    scores = LerfOvs().score(seen)
    assert [score.level for score in scores] == [2, 1]
    assert all(score.hit and score.iou is not None and score.iou > 0.85 for score in scores)
    alone = LerfOvs().score(evidence(levels[:1], Unit("wide", wide), Unit("narrow", narrow)))
    assert [(score.level, score.hit) for score in alone] == [(None, False), (None, False)]


def test_strict_is_lerf_ovs_but_for_localisation():
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(60.0), indexing="ij")
    ramp, flat = (x + y)[None, None] / 120, torch.full((1, 1, 60, 60), 0.5)
    unit = Unit("x", square(60, 60, 40, 40, 18))
    for maps, hits in ((ramp, (False, False)), (flat, (False, True))):
        strict, released = strict_and_released(evidence(maps, unit))
        assert (strict.loc_acc, released.loc_acc) == tuple(map(float, hits))
        assert strict.miou == released.miou
        assert strict.per_category == released.per_category
    assert (LerfOvs(strict=True).name, LerfOvs().name) == ("lerf_ovs_strict", "lerf_ovs")


def test_truth_as_prediction_scores_one_without_the_smoothing():
    mask = square(90, 90, 20, 30, 25)
    plain = Constants(box=1, vote=1)
    figures = LerfOvs(plain).conclude(
        LerfOvs(plain).score(evidence(mask.float()[None, None], Unit("x", mask))), ("x",)
    )
    assert (figures.miou, figures.loc_acc, figures.more["boundary_iou"]) == (1, 1, 1)


def test_noise_without_the_smoothing_scores_the_chance_of_its_threshold():
    # Uniform noise selects p = 0.3 of the map whatever the truth, a share q: IoU = pq / (p + q - pq).
    rng = torch.Generator().manual_seed(0)
    mask = square(200, 200, 0, 0, 100)
    score = score_unit(
        torch.rand(1, 200, 200, generator=rng), Unit("x", mask), Constants(box=1, vote=1)
    )
    p, q = 0.3, 0.25
    assert score.iou == pytest.approx(p * q / (p + q - p * q), abs=0.01)
