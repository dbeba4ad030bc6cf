"""Language supervision: rates, merges, borders, vectors."""

from itertools import pairwise

import numpy as np
import pytest

from vlgs.data.synthetic import NO_NOISE, LabelNoise
from vlgs.data.synthetic.language import NEGATIVES, mask_vector, text_vector, vocabulary
from vlgs.data.synthetic.masks import Region, view_masks

WORDS = tuple("abcdefgh")
SIDE = 48
QUILT = np.add.outer(8 * (np.arange(SIDE) // 8), np.arange(SIDE) // 8)  # squares of 8 x 8 pixels
REGIONS = {3: QUILT // 8, 2: QUILT, 1: QUILT}
NAMES = {
    level: {int(n): Region(WORDS[int(n) % 8], f"piece {n}") for n in np.unique(numbers)}
    for level, numbers in REGIONS.items()
}


def views(faults: LabelNoise, count: int = 60):
    return [view_masks(REGIONS, NAMES, WORDS, faults, (0, view)) for view in range(count)]


def owner(vector: np.ndarray) -> int:
    """Index of the nearest word."""
    return int((np.stack([text_vector(w) for w in WORDS]) @ vector).argmax())


def test_without_faults_masks_are_the_regions_and_vectors_belong_to_their_words():
    for masks, level in zip(views(NO_NOISE, 1)[0], range(4), strict=True):
        assert (masks.index >= 0).all()
        assert masks.index.max() == len(masks.vectors) - 1
        for row, vector in enumerate(masks.vectors):
            numbers = np.unique(REGIONS[max(level, 1)][masks.index == row])
            if level:
                assert len(numbers) == 1
                assert owner(vector) == int(numbers[0]) % 8


def test_missed_masks_leave_holes_at_their_rate():
    holes = [(masks[2].index == -1).mean() for masks in views(LabelNoise(0.2, 0.0, 0.0, 0.0, 0.0))]
    assert np.mean(holes) == pytest.approx(
        0.2, abs=0.02
    )  # 2160 masks: three standard deviations are 0.026


@pytest.mark.slow
def test_parts_are_missed_with_the_thing_they_are_of_at_the_shared_rate():
    for shared, same in ((1.0, 1.0), (0.8, 0.8 + 0.2 * (0.7**2 + 0.3**2)), (0.0, 0.7**2 + 0.3**2)):
        found = []
        for _, subpart, part, whole in views(LabelNoise(0.3, 0.0, 0.0, 0.0, 0.0, shared)):
            for finer in (part, subpart):
                agree = (finer.index == -1) == (whole.index == -1)
                found.append(agree.mean())
        assert np.mean(found) == pytest.approx(same, abs=0.04)  # of 360 things


def test_shared_fates_leave_whole_things_and_every_rate_as_they_were():
    alone, together = (
        views(LabelNoise(0.2, 0.1, 0.2, 0.3, 1.0, shared), 20) for shared in (0.0, 0.8)
    )
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one[3].index, other[3].index)
        assert np.array_equal(one[3].vectors, other[3].vectors)
        assert not np.array_equal(one[2].index, other[2].index)
    holes = [np.mean([(masks[1].index == -1).mean() for masks in each]) for each in (alone, together)]  # fmt: skip
    assert holes[1] == pytest.approx(holes[0], abs=0.08)


@pytest.mark.slow
def test_mislabelled_masks_carry_another_class_at_their_rate():
    wrong = []
    for _, _, part, _ in views(LabelNoise(0.0, 0.0, 0.15, 0.0, 0.0)):
        rows = part.index[4::8, 4::8].ravel()
        wrong += [
            owner(part.vectors[r]) != n % 8
            for r, n in zip(rows, QUILT[4::8, 4::8].ravel(), strict=True)
        ]
    assert np.mean(wrong) == pytest.approx(0.15, abs=0.025)


def test_merged_masks_join_a_neighbour_at_their_rate():
    merged = 0
    for _, _, part, _ in views(LabelNoise(0.0, 0.1, 0.0, 0.0, 0.0)):
        assert (part.index >= 0).all()
        merged += len(NAMES[2]) - len(part.vectors)
        for row in range(len(part.vectors)):
            numbers = np.unique(QUILT[part.index == row])
            steps = np.abs(np.subtract.outer(numbers, numbers))
            assert len(numbers) == 1 or np.isin(steps, (1, 8)).any(0).all()
    assert merged / (60 * 36) == pytest.approx(0.1, abs=0.02)


def test_merged_vector_is_the_mean_by_area():
    halves = {level: np.repeat(np.arange(40)[None] // 30, 20, 0) for level in (1, 2, 3)}
    names = {level: {0: Region("a", "a"), 1: Region("b", "b")} for level in halves}
    merged = view_masks(halves, names, WORDS, LabelNoise(0.0, 1.0, 0.0, 0.0, 0.0), (0, 0))[3]
    large, small = view_masks(halves, names, WORDS, NO_NOISE, (0, 0))[3].vectors
    mean = 0.75 * large + 0.25 * small
    np.testing.assert_allclose(merged.vectors, [mean / np.linalg.norm(mean)], atol=1e-6)
    assert (merged.index == 0).all()


@pytest.mark.parametrize("ragged", [1.0, 2.0])
def test_borders_move_by_the_configured_root_mean_square(ragged):
    half = {level: np.repeat(np.arange(200)[None] // 100, 200, 0) for level in (1, 2, 3)}
    names = {level: {0: Region("a", "a"), 1: Region("b", "b")} for level in half}
    moves = []
    for view in range(30):
        masks = view_masks(half, names, WORDS, LabelNoise(0.0, 0.0, 0.0, 0.0, ragged), (0, view))
        for masks_of_level in masks[1:]:
            moves.append((masks_of_level.index == 0).sum(1) - 100.0)
    assert np.sqrt(np.mean(np.square(moves))) == pytest.approx(ragged, rel=0.15)
    assert not np.array_equal(moves[0], moves[1])  # another level, another border
    assert not np.array_equal(moves[0], moves[3])  # another view


def test_small_regions_get_no_mask():
    regions = {level: np.zeros((100, 100), np.int64) for level in (1, 2, 3)}
    for numbers in regions.values():
        numbers[0, :4] = 1
    names = {level: {0: Region("a", "a"), 1: Region("b", "b")} for level in regions}
    masks = view_masks(regions, names, WORDS, NO_NOISE, (0, 0))[3]
    assert (masks.index[0, :4] == -1).all()


def test_default_level_lays_pieces_over_wholes():
    default = views(NO_NOISE, 1)[0][0]
    assert len(NAMES[3]) < len(default.vectors) <= len(NAMES[2]) * 2 + len(NAMES[3])
    np.testing.assert_array_equal(np.unique(default.index), np.arange(len(default.vectors)))


def test_draws_depend_on_seed_view_and_level_only():
    faults = LabelNoise(0.1, 0.1, 0.1, 0.3, 1.5)
    one, again = (view_masks(REGIONS, NAMES, WORDS, faults, (4, 7)) for _ in range(2))
    for a, b in zip(one, again, strict=True):
        np.testing.assert_array_equal(a.index, b.index)
        np.testing.assert_array_equal(a.vectors, b.vectors)
    for key in ((5, 7), (4, 8)):
        assert not np.array_equal(
            view_masks(REGIONS, NAMES, WORDS, faults, key)[2].index, one[2].index
        )


@pytest.mark.parametrize(
    "rates",
    [{"missed": -0.1}, {"missed": 0.6, "merged": 0.6}, {"noise": -1.0}, {"ragged": float("nan")}],
)
def test_impossible_faults_are_refused(rates):
    with pytest.raises(ValueError, match="LabelNoise: "):
        LabelNoise(**rates)


def test_a_rate_that_is_not_set_is_the_difficultys_own():
    assert LabelNoise(noise=0.7).resolve("easy") == LabelNoise(0.05, 0.03, 0.05, 0.7, 1.0, 0.8)
    assert LabelNoise().resolve("hard").missed == 0.10


def test_words_lie_in_one_cone():
    from vlgs.data.synthetic import layouts
    from vlgs.data.synthetic.scene_file import find_scene

    names = {
        t.name
        for s in ("glassware", "mirrors", "lookalikes", "patchwork")
        for t in layouts.build(find_scene(s), "hard", np.random.default_rng(0))
    }
    vectors = vocabulary(tuple(sorted(names))).vectors.double().numpy()
    cosines = (vectors @ vectors.T)[np.triu_indices(len(vectors), 1)]
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    assert cosines.mean() == pytest.approx(0.80, abs=0.01)
    assert cosines.min() > 0.69
    assert cosines.max() < 0.90


def test_mask_vectors_are_off_to_one_side_of_text():
    rng = np.random.default_rng(0)
    own, other, same = [], [], []
    for word, foreign in (("lemon", "mug"), ("book", "candle")):
        seen = [mask_vector(word, "", 3, 0.3, rng) for _ in range(50)]
        own += [v @ text_vector(word) for v in seen]
        other += [v @ text_vector(foreign) for v in seen]
        same += [a @ b for a, b in pairwise(seen)]
    assert np.mean(own) == pytest.approx(0.76, abs=0.02)
    assert np.mean(other) == pytest.approx(0.61, abs=0.04)
    assert 0.93 < np.mean(same) < 0.97


def test_exact_features_give_every_word_its_own_masks():
    words = (
        "wine glass",
        "glass bottle",
        "cookie jar",
        "lemon",
        "orange",
        "mug",
        "wooden table",
        "wall",
    )
    text = np.stack([text_vector(w) for w in words])
    against = np.stack([text_vector(w) for w in NEGATIVES])
    for i, word in enumerate(words):
        vector = mask_vector(word, "", 3, 0.0, np.random.default_rng(0))
        assert (text @ vector).argmax() == i
        relevancy = 1 / (1 + np.exp(10 * ((against @ vector).max() - text @ vector)))
        assert relevancy[i] > 0.7  # own word beats all negatives
        assert relevancy[i] > np.delete(relevancy, i).max() + 0.1
