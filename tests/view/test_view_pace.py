"""How large a picture may be, from how long others took."""

import pytest

from vlgs.view.pace import SMALLEST, Pace

FULL = 640 * 480


def learnt(budget: float, fixed: float, each: float, pictures: int = 10) -> Pace:
    pace = Pace(budget)
    for _ in range(pictures):
        scale = pace.scale(FULL)
        pixels = round(FULL * scale**2)
        pace.took(pixels, fixed + each * pixels)
    return pace


@pytest.mark.parametrize("fixed", [0.0, 0.01])
def test_a_picture_is_as_large_as_there_is_time_for(fixed: float):
    each = 0.2 / FULL  # all pixels would take 0.2 s
    pace = learnt(0.05, fixed, each)
    took = fixed + each * FULL * pace.scale(FULL) ** 2
    assert took == pytest.approx(0.05, rel=0.1)


def test_what_is_fast_enough_is_drawn_in_full():
    assert learnt(0.05, 0.002, 0.01 / FULL).scale(FULL) == 1.0


def test_where_the_fixed_part_is_too_slow_pixels_take_as_long_as_it_does():
    pace = learnt(0.05, 0.1, 0.4 / FULL)
    assert pace.scale(FULL) == pytest.approx(0.5, rel=0.1)


def test_the_slowest_has_a_smallest_size():
    assert learnt(0.05, 0.0, 100.0 / FULL).scale(FULL) == SMALLEST


def test_a_picture_that_was_held_up_changes_little():
    pace = learnt(0.05, 0.01, 0.2 / FULL)
    before = pace.scale(FULL)
    pace.took(round(FULL * before**2), 3.0)
    assert pace.scale(FULL) == pytest.approx(before, rel=0.1)
