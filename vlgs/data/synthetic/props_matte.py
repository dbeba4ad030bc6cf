"""Opaque things: red ones, ones of many colours, and plain ones. See `props_shiny`."""

from vlgs.data.synthetic.materials import (
    BLACK,
    BLUE,
    BROWN,
    CREAM,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    YELLOW,
    matte,
)
from vlgs.data.synthetic.patterns import Bands, Cells, Plain, Sectors, Wood
from vlgs.data.synthetic.shapes import Box, Torus, cone, cylinder, ellipsoid, sphere, turned
from vlgs.data.synthetic.things import Material, Part, Thing, turn

_UPRIGHT_RING = turn("x", 90.0)


def red_apple() -> Thing:
    """A round apple with a stalk."""
    return Thing(
        "red apple",
        (
            Part(ellipsoid(0.075, 0.068), matte(RED, 0.2), (0.0, 0.0, 0.066)),
            Part(cylinder(0.007, 0.035), matte(BROWN), (0.0, 0.0, 0.125), turn("y", 12.0)),
        ),
    )


def tomato() -> Thing:
    """Flatter than an apple, with green leaves on top."""
    return Thing(
        "tomato",
        (
            Part(ellipsoid(0.085, 0.058), matte(RED, 0.3), (0.0, 0.0, 0.057)),
            Part(ellipsoid(0.034, 0.008), matte(GREEN), (0.0, 0.0, 0.113)),
        ),
    )


def candle() -> Thing:
    """A thick candle with a black wick."""
    return Thing(
        "candle",
        (
            Part(cylinder(0.052, 0.20), matte(RED)),
            Part(cylinder(0.006, 0.03), matte(BLACK), (0.0, 0.0, 0.20)),
        ),
    )


def book() -> Thing:
    """A closed book lying flat: red covers around a cream block of pages."""
    return Thing(
        "book",
        (
            Part(Box((0.13, 0.095, 0.005)), matte(RED), (0.0, 0.0, 0.005)),
            Part(Box((0.125, 0.088, 0.019)), matte(CREAM), (0.0, 0.0, 0.029)),
            Part(Box((0.13, 0.095, 0.005)), matte(RED), (0.0, 0.0, 0.053)),
            Part(Box((0.005, 0.095, 0.029)), matte(RED), (-0.130, 0.0, 0.029)),
        ),
    )


def gift_box() -> Thing:
    """A red box with a red ribbon."""
    ribbon = matte((0.82, 0.20, 0.18), 0.2)
    return Thing(
        "gift box",
        (
            Part(Box((0.085, 0.085, 0.075)), matte(RED), (0.0, 0.0, 0.075)),
            Part(Box((0.018, 0.088, 0.078)), ribbon, (0.0, 0.0, 0.076)),
            Part(Box((0.088, 0.018, 0.078)), ribbon, (0.0, 0.0, 0.076)),
            Part(Torus(0.026, 0.009), ribbon, (0.024, 0.0, 0.175), turn("x", 70.0)),
            Part(Torus(0.026, 0.009), ribbon, (-0.024, 0.0, 0.175), turn("x", 70.0)),
        ),
    )


def rubber_ball() -> Thing:
    """A plain ball."""
    return Thing("rubber ball", (Part(sphere(0.08), matte(RED), (0.0, 0.0, 0.08)),))


def bell_pepper() -> Thing:
    """A tall pepper with a green stem, leaning."""
    body = turned((-0.07, 0.015, 0.07), (0.042, 0.070, 0.058))
    return Thing(
        "bell pepper",
        (
            Part(body, matte(RED, 0.35), (0.0, 0.0, 0.075), turn("y", 8.0)),
            Part(cone(0.02, 0.012, 0.045), matte(GREEN), (0.009, 0.0, 0.143), turn("y", 20.0)),
        ),
    )


def _mug(name: str, material: Material) -> Thing:
    return Thing(
        name,
        (
            Part(cylinder(0.068, 0.14, open_top=True), material),
            Part(Torus(0.042, 0.011), material, (0.085, 0.0, 0.072), _UPRIGHT_RING),
        ),
    )


def red_mug() -> Thing:
    """A mug of one colour."""
    return _mug("mug", matte(RED, 0.2))


def blue_mug() -> Thing:
    """The same in blue."""
    return _mug("mug", matte(BLUE, 0.2))


def striped_mug() -> Thing:
    """A mug with four stripes."""
    return _mug("mug", Material(Bands((BLUE, CREAM, ORANGE, GREEN), 0.035), gloss=0.15))


def beach_ball() -> Thing:
    """Six slices, tilted."""
    slices = Sectors((RED, CREAM, BLUE, CREAM, YELLOW, CREAM))
    return Thing(
        "beach ball", (Part(sphere(0.105), Material(slices), (0.0, 0.0, 0.105), turn("x", 35.0)),)
    )


def puzzle_cube() -> Thing:
    """Three cells a side, six colours."""
    cells = Cells((RED, YELLOW, BLUE, CREAM, GREEN, ORANGE), (0.05, 0.05, 0.05))
    return Thing(
        "puzzle cube", (Part(Box((0.075, 0.075, 0.075)), Material(cells), (0.0, 0.0, 0.075)),)
    )


def stacking_rings() -> Thing:
    """Five rings on a peg, as toddlers have them."""
    colors = (BLUE, GREEN, YELLOW, ORANGE, RED)
    rings = tuple(
        Part(Torus(0.064 - 0.008 * i, 0.024), matte(color), (0.0, 0.0, 0.04 + 0.042 * i))
        for i, color in enumerate(colors)
    )
    base = Part(cylinder(0.092, 0.018), matte(CREAM))
    peg = Part(cylinder(0.022, 0.25), matte(CREAM))
    return Thing("stacking rings", (base, peg, *rings))


def patchwork_cushion() -> Thing:
    """A flat cushion of square patches."""
    cells = Cells((PURPLE, CREAM, GREEN, YELLOW, BLUE), (0.075, 0.075, 1.0))
    return Thing("cushion", (Part(ellipsoid(0.16, 0.055), Material(cells), (0.0, 0.0, 0.055)),))


def toy_robot() -> Thing:
    """Boxes of six colours; what belongs together cannot be told by colour."""
    return Thing(
        "toy robot",
        (
            Part(Box((0.060, 0.042, 0.065)), matte(BLUE), (0.0, 0.0, 0.135)),
            Part(Box((0.042, 0.038, 0.038)), matte(YELLOW), (0.0, 0.0, 0.238)),
            Part(Box((0.020, 0.030, 0.036)), matte(GREEN), (0.033, 0.0, 0.036)),
            Part(Box((0.020, 0.030, 0.036)), matte(GREEN), (-0.033, 0.0, 0.036)),
            Part(Box((0.014, 0.022, 0.058)), matte(RED), (0.076, 0.0, 0.135)),
            Part(Box((0.014, 0.022, 0.058)), matte(ORANGE), (-0.076, 0.0, 0.135)),
            Part(sphere(0.013), matte(BLACK, 0.3), (0.017, -0.037, 0.246)),
            Part(sphere(0.013), matte(BLACK, 0.3), (-0.017, -0.037, 0.246)),
        ),
    )


def layer_cake() -> Thing:
    """Layers of three colours, white icing and a cherry."""
    return Thing(
        "cake",
        (
            Part(cylinder(0.115, 0.012), matte((0.55, 0.70, 0.78), 0.2)),
            Part(
                cylinder(0.095, 0.11),
                Material(Bands((BROWN, CREAM, (0.86, 0.52, 0.56)), 0.028)),
                (0.0, 0.0, 0.012),
            ),
            Part(ellipsoid(0.095, 0.022), matte(CREAM), (0.0, 0.0, 0.122)),
            Part(sphere(0.022), matte(RED, 0.4), (0.0, 0.0, 0.155)),
        ),
    )


def spinning_top() -> Thing:
    """A cone on its point, banded, with a peg."""
    bands = Bands((RED, YELLOW, BLUE, CREAM), 0.035)
    return Thing(
        "spinning top",
        (
            Part(cone(0.012, 0.095, 0.10), Material(bands), (0.0, 0.0, 0.0)),
            Part(ellipsoid(0.095, 0.03), matte(PURPLE), (0.0, 0.0, 0.10)),
            Part(cylinder(0.012, 0.06), matte(BROWN), (0.0, 0.0, 0.125)),
        ),
    )


def lemon() -> Thing:
    """A lemon lying on its side."""
    return Thing(
        "lemon",
        (Part(ellipsoid(0.055, 0.075), matte(YELLOW), (0.0, 0.0, 0.055), turn("y", 90.0)),),
    )


def orange() -> Thing:
    """A round fruit."""
    return Thing("orange", (Part(sphere(0.07), matte(ORANGE), (0.0, 0.0, 0.07)),))


def wooden_bowl() -> Thing:
    """An open bowl."""
    bowl = turned((0.0, 0.04, 0.085), (0.05, 0.095, 0.12), closed_high=False)
    return Thing("wooden bowl", (Part(bowl, Material(Wood((0.66, 0.44, 0.24), BROWN, 0.07))),))


def plant() -> Thing:
    """A round bush in a clay pot."""
    leaves = Material(Plain((0.24, 0.46, 0.20), grain=0.28, scale=0.05))
    return Thing(
        "potted plant",
        (
            Part(cone(0.055, 0.078, 0.11), matte((0.72, 0.38, 0.24))),
            Part(ellipsoid(0.10, 0.085), leaves, (0.0, 0.0, 0.17)),
        ),
    )
