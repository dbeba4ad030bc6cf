"""The room that a table stands in, the table, and its lamp.

World axes: z up, the table top is z = 0, metres. Most cameras stand on the side of negative y.
"""

import numpy as np

from vlgs.data.synthetic.lights import Light
from vlgs.data.synthetic.objects import Material, Part, Thing
from vlgs.data.synthetic.patterns import Bands, Cells, Plain, Wood
from vlgs.data.synthetic.shapes import Box, cylinder

TABLE_RADIUS = 0.72
FLOOR = -0.72
ROOM = 2.3
"""Half the side of the square room."""
CEILING = 1.9

LAMP = Light((0.45, -0.75, CEILING - 0.06), 0.26)
"""The lamp under the ceiling, for scenes that have none of their own."""


def table() -> Thing:
    """A round table of wood on one leg."""
    wood = Material(Wood((0.73, 0.56, 0.38), (0.64, 0.46, 0.29), 0.13))
    return Thing(
        "wooden table",
        (
            Part(cylinder(TABLE_RADIUS, 0.045), wood, (0.0, 0.0, -0.045)),
            Part(cylinder(0.07, -FLOOR - 0.045), wood, (0.0, 0.0, FLOOR)),
            Part(cylinder(0.30, 0.03), wood, (0.0, 0.0, FLOOR)),
        ),
        background=True,
    )


def wall(light: Light = LAMP) -> Thing:
    """Four walls with a darker lower half, a bright window behind most cameras, the ceiling, and the lamp."""
    bottom = FLOOR - 0.1  # under the floor, so that no two surfaces coincide
    middle, half = (CEILING + bottom) / 2, (CEILING - bottom) / 2
    border = 0.25
    paint = Bands(
        ((0.40, 0.52, 0.54), (0.84, 0.81, 0.73)), 9.0, start=border - middle - 9.0, scale=0.8
    )
    white = Material(Plain((1.0, 1.0, 0.97), grain=0.0), "light")
    behind = np.array(light.center) + 0.01 * np.array(light.axes)[:, 2]
    x, y, z = behind.tolist()
    return Thing(
        "wall",
        (
            Part(Box((ROOM, ROOM, half)), Material(paint), (0.0, 0.0, middle)),
            Part(Box((0.55, 0.03, 0.45)), white, (-0.5, -ROOM, 0.95)),
            Part(cylinder(light.radius + 0.02, 0.03), white, (x, y, z), light.axes),
        ),
        background=True,
    )


def floor() -> Thing:
    """Square tiles."""
    tiles = Cells(((0.60, 0.54, 0.48), (0.50, 0.45, 0.41)), (0.46, 0.46, 1.0), grain=0.05)
    slab = Part(Box((ROOM, ROOM, 0.02)), Material(tiles), (0.0, 0.0, FLOOR - 0.02))
    return Thing("tiled floor", (slab,), background=True)
