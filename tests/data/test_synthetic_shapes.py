"""Rays against surfaces: values by hand, points on the surface, normals against finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vlgs.data.synthetic.shapes import Box, Torus, cone, cylinder, ellipsoid, sphere, turned

SHAPES = {
    "sphere": sphere(0.3),
    "ellipsoid": ellipsoid(0.2, 0.35),
    "cylinder": cylinder(0.2, 0.5),
    "tumbler": cylinder(0.2, 0.5, open_top=True),
    "cone": cone(0.3, 0.1, 0.4),
    "waist": turned((0.0, 0.2, 0.5), (0.2, 0.1, 0.3)),
    "belly": turned((0.0, 0.2, 0.5), (0.1, 0.3, 0.2), closed_high=False),
    "box": Box((0.1, 0.2, 0.3)),
    "torus": Torus(0.3, 0.08),
}


def hit(shape, origin, direction, t_min=0.0):
    direction = np.array(direction, float)[:, None] / np.linalg.norm(direction)
    t, face = shape.intersect(np.array(origin, float)[:, None], direction, np.array([t_min]))
    return float(t[0]), int(face[0])


@pytest.mark.parametrize(
    ("shape", "origin", "direction", "t", "face"),
    [
        (sphere(1.0), (-3, 0, 0), (1, 0, 0), 2.0, 0),
        (sphere(1.0), (0, 0, 0), (0, 0, 1), 1.0, 0),
        (sphere(1.0), (-3, 1.001, 0), (1, 0, 0), np.inf, 0),
        (sphere(1.0), (3, 0, 0), (1, 0, 0), np.inf, 0),
        (cylinder(0.5, 2.0), (-2, 0, 1), (1, 0, 0), 1.5, 0),
        (cylinder(0.5, 2.0), (0.2, 0, 5), (0, 0, -1), 3.0, 2),
        (cylinder(0.5, 2.0), (0.2, 0, -5), (0, 0, 1), 5.0, 1),
        (cylinder(0.5, 2.0, open_top=True), (0.2, 0, 5), (0, 0, -1), 5.0, 1),
        (cone(1.0, 0.0, 1.0), (-3, 0, 0.5), (1, 0, 0), 2.5, 0),
        (Box((1.0, 2.0, 3.0)), (-5, 0, 0), (1, 0, 0), 4.0, 0),
        (Box((1.0, 2.0, 3.0)), (0, 7, 1), (0, -1, 0), 5.0, 3),
        (Box((1.0, 2.0, 3.0)), (0, 0, 0), (0, 0, 1), 3.0, 5),
        (Torus(1.0, 0.25), (-5, 0, 0), (1, 0, 0), 3.75, 0),
        (Torus(1.0, 0.25), (0, 0, 5), (0, 0, -1), np.inf, 0),
        (Torus(1.0, 0.25), (1, 0, 5), (0, 0, -1), 4.75, 0),
    ],
)
def test_first_hit_by_hand(shape, origin, direction, t, face):
    got = hit(shape, origin, direction)
    assert got[0] == pytest.approx(t, abs=1e-9)
    assert got[1] == face


def test_second_surface_lies_behind_the_first():
    assert hit(sphere(1.0), (-3, 0, 0), (1, 0, 0), t_min=2.5)[0] == pytest.approx(4.0)
    assert hit(Box((1.0, 1.0, 1.0)), (-3, 0, 0), (1, 0, 0), t_min=2.5) == (4.0, 1)


def test_turned_shape_has_the_radii_it_was_given():
    shape = turned((0.0, 0.2, 0.5), (0.2, 0.1, 0.3))
    assert [shape.radius2(z) ** 0.5 for z in (0.0, 0.2, 0.5)] == pytest.approx([0.2, 0.1, 0.3])


def distance_to_surface(name: str, point: np.ndarray) -> np.ndarray:
    """Zero on the surface, by a formula of its own per shape."""
    x, y, z = point
    ring = np.hypot(x, y)
    if name == "sphere":
        return np.abs(np.sqrt(x * x + y * y + z * z) - 0.3)
    if name == "box":
        return np.abs(np.max([np.abs(x) / 0.1, np.abs(y) / 0.2, np.abs(z) / 0.3], axis=0) - 1)
    if name == "torus":
        return np.abs(np.hypot(ring - 0.3, z) - 0.08)
    shape = SHAPES[name]
    side = np.abs(ring**2 - np.array([shape.radius2(h) for h in z]))
    caps = [
        np.abs(z - h)
        for h, closed in ((shape.low, shape.closed_low), (shape.high, shape.closed_high))
        if closed
    ]
    return np.min([side, *caps], axis=0)


@pytest.mark.parametrize("name", SHAPES)
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_hits_lie_on_the_surface_inside_the_bound(name, seed):
    shape, rng = SHAPES[name], np.random.default_rng(seed)
    origin, direction = rng.normal(size=(2, 3, 200))
    direction = rng.normal(0, 0.2, (3, 200)) - origin  # towards the shape
    direction /= np.linalg.norm(direction, axis=0)
    t, _ = shape.intersect(origin, direction, np.zeros(200))
    found = np.isfinite(t)
    point = (origin + np.where(found, t, 0) * direction)[:, found]
    assert (t[found] > 0).all()
    tolerance = 1e-7
    assert (distance_to_surface(name, point) < tolerance).all()
    height, radius = shape.bound()
    assert (np.linalg.norm(point - [[0], [0], [height]], axis=0) <= radius + tolerance).all()


@pytest.mark.parametrize("name", SHAPES)
def test_normal_is_perpendicular_to_the_surface_around_it(name):
    shape, rng = SHAPES[name], np.random.default_rng(3)
    origin = np.array([[1.1], [-0.9], [0.8]])
    goal = rng.normal(0, 0.15, (3, 300))
    directions = []
    for shift in ((0, 0, 0), (1e-5, 0, 0), (0, 1e-5, 0)):
        towards = goal + np.array(shift)[:, None] - origin
        directions.append(towards / np.linalg.norm(towards, axis=0))
    hits = [shape.intersect(origin, d, np.zeros(300)) for d in directions]
    same = (
        np.isfinite([t for t, _ in hits]).all(0)
        & (hits[0][1] == hits[1][1])
        & (hits[0][1] == hits[2][1])
    )
    points = [origin + np.where(same, t, 0) * d for (t, _), d in zip(hits, directions, strict=True)]
    tangents = [(p - points[0])[:, same] for p in points[1:]]
    same_sheet = (np.linalg.norm(tangents, axis=1) < 1e-3).all(0)
    normal = shape.normal(points[0][:, same], hits[0][1][same])
    assert np.linalg.norm(normal, axis=0) == pytest.approx(1, abs=1e-6)
    assert same_sheet.sum() > 20
    for tangent in tangents:
        slope = (normal * tangent).sum(0)[same_sheet] / np.linalg.norm(tangent, axis=0)[same_sheet]
        assert np.abs(slope).max() < 0.02
    facing = (normal * directions[0][:, same]).sum(0)
    if name not in ("tumbler", "belly"):  # closed from above: seen from outside only
        assert (facing < 1e-3).all()


def test_torus_agrees_with_the_roots_of_its_quartic():
    rng = np.random.default_rng(0)
    origin = rng.normal(size=(3, 100))
    direction = rng.normal(0, 0.3, (3, 100)) - origin
    direction /= np.linalg.norm(direction, axis=0)
    got, _ = Torus(0.5, 0.2).intersect(origin, direction, np.zeros(100))
    for i in range(100):
        o, d = origin[:, i], direction[:, i]
        round_part = np.array([1.0, 2 * o @ d, o @ o + 0.5**2 - 0.2**2])
        flat_part = np.array([d[:2] @ d[:2], 2 * o[:2] @ d[:2], o[:2] @ o[:2]])
        square = np.convolve(round_part, round_part)
        square[2:] -= 4 * 0.5**2 * flat_part
        roots = np.roots(square)
        real = sorted(r.real for r in roots if abs(r.imag) < 1e-9 and r.real > 0)
        assert got[i] == pytest.approx(real[0] if real else np.inf, abs=1e-6)
