"""Surroundings in which a camera can go wrong: a sky and a plain wall, on which structure from motion finds no point."""

from vlgs.data.synthetic.objects import Material, Part, Thing
from vlgs.data.synthetic.patterns import Cells, Gradient
from vlgs.data.synthetic.shapes import Box, cylinder, sphere

STAGES = ("ring", "sky", "wall")
"""Other stages than the room that is seen from a walk: the room, seen from a ring; under a sky, from a ring; before a plain wall, from an
arc."""
VERSION = 1
"""Part of the fingerprint of these scenes; raise it with any change that moves one of their pixels, labels or points."""

_SKY_RADIUS = 40.0
_WALL_DISTANCE = 3.0
_PATIO_RADIUS = 1.7


def surroundings(stage: str, floor: float) -> tuple[Thing, ...]:
    """What stands around the table instead of the room.

    Args:
        stage: ``sky`` or ``wall``.
        floor: Height of the ground.
    """
    tiles = Material(Cells(((0.60, 0.54, 0.48), (0.50, 0.45, 0.41)), (0.46, 0.46, 1.0), grain=0.05))
    if stage == "sky":
        blue = Gradient((0.86, 0.88, 0.88), (0.36, 0.56, 0.86), -4.0, 26.0)
        dome = Part(sphere(_SKY_RADIUS), Material(blue, "light"))
        patio = Part(cylinder(_PATIO_RADIUS, 0.04), tiles, (0.0, 0.0, floor - 0.04))
        return Thing("sky", (dome,), background=True, masked=False), _ground(patio)
    slab = Part(Box((2 * _WALL_DISTANCE, _WALL_DISTANCE, 0.02)), tiles, (0.0, 0.0, floor - 0.02))
    cream = Gradient((0.70, 0.68, 0.64), (0.88, 0.86, 0.80), -2.0, 4.0)
    # From inside, a box is left through its far side: three plain walls, and one behind the cameras.
    hall = Box((2 * _WALL_DISTANCE, _WALL_DISTANCE, 2 * _WALL_DISTANCE))
    return Thing("wall", (Part(hall, Material(cream, "light")),), background=True), _ground(slab)


def _ground(part: Part) -> Thing:
    return Thing("tiled floor", (part,), background=True)
