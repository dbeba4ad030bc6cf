"""Gaussians out of every view go, and faint ones in the air before a camera; others stay."""

import math

import pytest
import torch
from torch import Tensor

from vlgs.gaussians.strays import Strays
from vlgs.types import Camera, Scene, View

NEAREST = 2.0
"""Distance of the nearest sparse point that the first camera sees."""


def camera(turn: float, x: float) -> Camera:
    """At (x, 0, 0); without a turn it looks along z, 45 degrees to either side."""
    c, s = math.cos(turn), math.sin(turn)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([x, 0.0, 0.0])
    return Camera(
        viewmat, torch.tensor([[8.0, 0.0, 8.0], [0.0, 8.0, 8.0], [0.0, 0.0, 1.0]]), 16, 16
    )


def strays(points: list[list[float]]) -> Strays:
    """Two cameras back to back: one unit apart, and no point before the second."""
    views = tuple(
        View(name, camera(turn, x), lambda: torch.zeros(16, 16, 3, dtype=torch.uint8))
        for name, turn, x in (("front", 0.0, 0.0), ("back", math.pi, 1.0))
    )
    given = torch.tensor(points)
    colors = torch.zeros(given.shape, dtype=torch.uint8)
    none = torch.zeros(0, 8), torch.zeros(0)
    return Strays(Scene("toy", views, (), "all", given, colors, *none))


POINTS = [[0.0, 0.0, NEAREST], [1.0, 0.0, 3.0], [9.0, 0.0, 0.5], [math.nan, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("mean", "opaque", "faint"),
    [
        ((0.0, 0.0, 1.9), False, True),  # in the air before the first camera
        ((0.0, 0.0, 2.1), False, False),  # behind its nearest point
        ((1.5, 0.0, 1.6), False, False),  # farther from it than that, though less deep
        ((1.0, 0.0, -0.5), False, False),  # before the second, of which no point says anything
        ((2.2, 0.0, 0.1), True, True),  # between the two: no image has it
        ((0.0, 0.0, 0.0), True, True),  # in the camera
        ((90.0, 0.0, 0.0), False, False),  # out of view as well, but a background
    ],
)
def test_what_strays(mean: tuple[float, float, float], opaque: bool, faint: bool):
    find, means = strays(POINTS), torch.tensor([mean])
    assert find(means, torch.tensor([False])).tolist() == [opaque]
    assert find(means, torch.tensor([True])).tolist() == [faint]


def test_in_the_air_is_nothing_without_points():
    find, means = strays([[math.nan] * 3]), torch.tensor([[0.0, 0.0, 0.1], [0.3, 0.0, 5.0]])
    everything: Tensor = torch.ones(2, dtype=torch.bool)
    assert not find(means, everything).any()
    assert not find.in_air(means, everything).any()
