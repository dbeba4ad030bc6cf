"""What counts as the air before a camera."""

import math

import pytest
import torch

from vlgs.gaussians.in_air import Air, narrow, near_plane
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


def scene(points: list[list[float]]) -> Scene:
    """Two cameras back to back: one unit apart, and no point before the second."""
    views = tuple(
        View(name, camera(turn, x), lambda: torch.zeros(16, 16, 3, dtype=torch.uint8))
        for name, turn, x in (("front", 0.0, 0.0), ("back", math.pi, 1.0))
    )
    given = torch.tensor(points)
    colors = torch.zeros(given.shape, dtype=torch.uint8)
    none = torch.zeros(0, 8), torch.zeros(0)
    return Scene("toy", views, (), "all", given, colors, *none)


POINTS = [[0.0, 0.0, NEAREST], [1.0, 0.0, 3.0], [9.0, 0.0, 0.5], [math.nan, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("mean", "inside"),
    [
        ((0.0, 0.0, 1.9), True),  # before the first camera
        ((0.0, 0.0, 2.1), False),  # behind its nearest point
        ((1.5, 0.0, 1.6), False),  # farther from it than that, though less deep
        ((1.0, 0.0, -0.5), False),  # before the second, of which no point says anything
        ((2.2, 0.0, 0.1), False),  # between the two: no image has it
    ],
)
def test_what_is_in_the_air(mean: tuple[float, float, float], inside: bool):
    assert Air(scene(POINTS))(torch.tensor([mean])).tolist() == [inside]


def test_nothing_is_in_the_air_without_points():
    means = torch.tensor([[0.0, 0.0, 0.1], [0.3, 0.0, 5.0]])
    assert not Air(scene([[math.nan] * 3]))(means).any()


@pytest.mark.parametrize(
    ("depths", "near"),
    [
        ([2.0, 3.0, 4.0, *[9.0] * 300], 2.0),  # half of the third: two may be stray
        ([*[9.0] * 300, 4.0, 3.0, 2.0], 2.0),
        ([2.0, 3.0, 4.0, *[9.0] * 150], 1.5),  # one in a hundred
        ([2.0, *[9.0] * 98, *[-1.0] * 9], 1.0),  # these are behind the camera
        ([-1.0] * 300, 0.0),
        ([2.0] * 99, 0.0),  # too few
        ([1e13] * 300, 0.0),  # as broken as a NaN
    ],
)
def test_the_near_plane_is_a_share_of_the_nearest_points_depth(depths: list[float], near: float):
    beside = [[0.9 * z, 0.0, z] for z in depths]  # at the image's edge: depth, not distance
    assert near_plane(scene([*beside, [math.nan] * 3]), 0.5) == pytest.approx(near)


def test_the_camera_that_comes_nearest_says_where_it_is():
    behind = [[1.0, 0.0, -z] for z in (0.8, 0.9)]  # seen by the second camera alone
    before = [[0.0, 0.0, 2.0]] * 200
    assert near_plane(scene([*behind, *before]), 0.5) == pytest.approx(0.4)


def test_what_reaches_the_nearest_camera_is_cut_down_and_nothing_else():
    centers = torch.tensor([[0.0, 0.0, 0.0], [8.0, 0.0, 0.0]])
    means = torch.tensor([[3.0, 0.0, 0.0], [6.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    scales = torch.tensor([[0.5, 1.5, 1.0], [0.1, 0.6, 0.4], [2.0, 0.01, 0.2]])
    cut = scales.log()
    narrow(cut, means, centers, most=1 / 3, near=0.3)
    want = torch.tensor([[0.5, 1.0, 1.0], [0.1, 0.6, 0.4], [0.1, 0.01, 0.1]])
    torch.testing.assert_close(cut.exp(), want)
    as_they_were = (scales < want * 1.001) & (want < scales * 1.001)
    assert torch.equal(cut[as_they_were], scales.log()[as_they_were])
