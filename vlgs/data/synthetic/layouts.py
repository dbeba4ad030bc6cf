"""Which things stand where: four scenes at two difficulties, in a room with a round table.

World axes: z up, the table top is z = 0, metres. Most cameras stand on the side of negative y.
"""

from collections.abc import Callable

import numpy as np

from vlgs.data.synthetic import props_matte as matte
from vlgs.data.synthetic import props_shiny as shiny
from vlgs.data.synthetic.outdoors import STAGES, name_parts, surroundings
from vlgs.data.synthetic.patterns import Bands, Cells, Plain, Wood
from vlgs.data.synthetic.shapes import Box, cylinder
from vlgs.data.synthetic.things import Material, Part, Thing, place

TABLE_RADIUS = 0.72
FLOOR = -0.72
ROOM = 2.3
"""Half the side of the square room."""
CEILING = 1.9

LAMP = (0.45, -0.75, CEILING - 0.06)
"""Centre of the lamp: the light of every shade, shadow and highlight."""

Spot = tuple[Callable[[], Thing], float, float, float]
"""What, x, y, and degrees about the vertical."""

EASY: dict[str, tuple[Spot, ...]] = {
    "glassware": (
        (shiny.wine_glass, -0.16, -0.33, 0.0),
        (shiny.glass_of_water, 0.17, -0.36, 0.0),
        (shiny.glass_bottle, -0.38, 0.02, 0.0),
        (shiny.cookie_jar, 0.42, -0.02, 0.0),
        (shiny.snow_globe, 0.02, -0.02, 0.0),
        (matte.orange, 0.20, 0.20, 0.0),
        (matte.blue_mug, -0.19, 0.30, 40.0),
        (matte.lemon, -0.42, -0.27, 30.0),
        (matte.plant, 0.16, 0.46, 0.0),
    ),
    "mirrors": (
        (shiny.steel_kettle, -0.33, -0.16, -150.0),
        (shiny.chrome_ball, 0.04, -0.36, 0.0),
        (shiny.vanity_mirror, 0.0, 0.20, 0.0),
        (shiny.silver_vase, 0.40, -0.12, 0.0),
        (matte.orange, 0.22, -0.20, 0.0),
        (matte.blue_mug, -0.12, -0.05, -60.0),
        (matte.wooden_bowl, 0.36, 0.24, 0.0),
        (matte.lemon, -0.22, -0.42, 20.0),
        (matte.plant, -0.36, 0.30, 0.0),
    ),
    "lookalikes": (
        (matte.red_apple, -0.12, -0.40, 0.0),
        (matte.tomato, 0.13, -0.37, 0.0),
        (matte.red_mug, -0.38, -0.12, -130.0),
        (matte.candle, 0.38, -0.14, 0.0),
        (matte.book, -0.06, -0.10, 25.0),
        (matte.gift_box, 0.18, 0.16, 20.0),
        (matte.rubber_ball, -0.28, 0.22, 0.0),
        (matte.bell_pepper, 0.42, 0.22, 60.0),
        (matte.plant, -0.02, 0.44, 0.0),
    ),
    "patchwork": (
        (matte.puzzle_cube, -0.17, -0.35, 25.0),
        (matte.striped_mug, 0.14, -0.38, -50.0),
        (matte.beach_ball, -0.42, -0.04, 0.0),
        (matte.stacking_rings, 0.39, -0.10, 0.0),
        (matte.toy_robot, 0.02, -0.03, 10.0),
        (matte.patchwork_cushion, -0.20, 0.33, 0.0),
        (matte.layer_cake, 0.24, 0.27, 0.0),
        (matte.lemon, 0.42, -0.36, 30.0),
    ),
}

HARD: dict[str, tuple[Spot, ...]] = {
    "glassware": (
        *EASY["glassware"],
        (shiny.wine_glass, 0.33, -0.24, 0.0),
        (shiny.glass_vase, -0.17, -0.10, 0.0),
        (shiny.glass_of_water, -0.03, 0.22, 0.0),
        (matte.red_apple, 0.40, 0.30, 0.0),
    ),
    "mirrors": (
        *EASY["mirrors"],
        (shiny.toaster, 0.12, 0.40, 15.0),
        (shiny.steel_pot, -0.38, 0.06, 30.0),
        (matte.red_apple, 0.20, 0.03, 0.0),
        (shiny.chrome_ball, 0.46, 0.06, 0.0),
    ),
    "lookalikes": (
        *EASY["lookalikes"],
        (matte.red_apple, 0.20, -0.12, 0.0),
        (matte.tomato, -0.28, -0.30, 0.0),
        (matte.candle, -0.20, 0.40, 0.0),
        (matte.red_mug, 0.30, 0.40, 70.0),
    ),
    "patchwork": (
        *EASY["patchwork"],
        (matte.spinning_top, 0.24, -0.14, 0.0),
        (matte.striped_mug, -0.20, -0.13, 100.0),
        (matte.spinning_top, -0.38, 0.18, 0.0),
        (matte.toy_robot, 0.48, 0.16, 70.0),
    ),
}

SCENES = tuple(EASY)
STAGED = tuple(f"{layout}_{stage}" for layout in SCENES for stage in STAGES)
"""The same tables, seen from a ring or an arc, with views between, beyond and above it held out (`vlgs.data.synthetic.outdoors`)."""
DIFFICULTIES = ("easy", "hard")


def build(scene: str, difficulty: str, rng: np.random.Generator) -> tuple[Thing, ...]:
    """The things of a scene in the world frame: what stands on the table first, then table, wall and floor.

    Another seed moves every thing by up to 1 cm and turns it by up to 12 degrees: a sibling of the scene, not a copy.
    """
    layout, stage = name_parts(scene)
    spots = (EASY if difficulty == "easy" else HARD)[layout]
    things = []
    for make, x, y, degrees in spots:
        dx, dy, turned = rng.uniform(-1, 1, 3) * (0.01, 0.01, 12.0)
        things.append(place(make(), x + float(dx), y + float(dy), degrees + float(turned)))
    if stage in (None, "ring"):
        return (*things, _table(), _wall(), _floor())
    return (*things, _table(), *surroundings(stage, FLOOR))


def _table() -> Thing:
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


def _wall() -> Thing:
    """Four walls with a darker lower half, a bright window behind most cameras, and the ceiling with its lamp."""
    bottom = FLOOR - 0.1  # under the floor, so that no two surfaces coincide
    middle, half = (CEILING + bottom) / 2, (CEILING - bottom) / 2
    border = 0.25
    paint = Bands(
        ((0.40, 0.52, 0.54), (0.84, 0.81, 0.73)), 9.0, start=border - middle - 9.0, scale=0.8
    )
    white = Material(Plain((1.0, 1.0, 0.97), grain=0.0), "light")
    return Thing(
        "wall",
        (
            Part(Box((ROOM, ROOM, half)), Material(paint), (0.0, 0.0, middle)),
            Part(Box((0.55, 0.03, 0.45)), white, (-0.5, -ROOM, 0.95)),
            Part(cylinder(0.28, 0.03), white, (LAMP[0], LAMP[1], CEILING - 0.05)),
        ),
        background=True,
    )


def _floor() -> Thing:
    tiles = Cells(((0.60, 0.54, 0.48), (0.50, 0.45, 0.41)), (0.46, 0.46, 1.0), grain=0.05)
    slab = Part(Box((ROOM, ROOM, 0.02)), Material(tiles), (0.0, 0.0, FLOOR - 0.02))
    return Thing("tiled floor", (slab,), background=True)
