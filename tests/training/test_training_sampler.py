from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vlgs.data.sampler import PairSampler


@given(st.integers(2, 30), st.integers(0, 2**31), st.integers(0, 10_000))
def test_a_pair_is_a_function_of_seed_and_step(count: int, seed: int, step: int):
    sizes = ((8, 6),) * count
    first, second = PairSampler(sizes, seed).pair(step)
    assert (first, second) == PairSampler(sizes, seed).pair(step)
    assert first != second
    assert 0 <= first < count
    assert 0 <= second < count


def test_every_view_is_first_once_per_epoch():
    sampler = PairSampler(((8, 6),) * 7, seed=3)
    for epoch in range(4):
        assert Counter(sampler.pair(epoch * 7 + i)[0] for i in range(7)) == Counter(range(7))


def test_views_of_different_sizes_are_never_paired():
    sizes = ((8, 6), (8, 6), (4, 3), (4, 3), (5, 5))
    sampler = PairSampler(sizes, seed=0)
    for step in range(200):
        first, second = sampler.pair(step)
        assert sizes[first] == sizes[second]
        assert first != second or first == 4  # the fifth size stands alone


def test_a_single_view_is_its_own_pair():
    assert PairSampler(((8, 6),), seed=0).pair(5) == (0, 0)


def test_seeds_differ():
    a, b = (PairSampler(((8, 6),) * 20, seed) for seed in (0, 1))
    assert [a.pair(i) for i in range(20)] != [b.pair(i) for i in range(20)]


def test_no_views_is_refused():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        PairSampler((), seed=0)
