"""Colours and the three materials that most things are made of."""

from vlgs.data.synthetic.patterns import Color, Plain
from vlgs.data.synthetic.things import Material

RED: Color = (0.74, 0.13, 0.11)
ORANGE: Color = (0.90, 0.47, 0.12)
YELLOW: Color = (0.92, 0.78, 0.20)
GREEN: Color = (0.22, 0.52, 0.24)
BLUE: Color = (0.16, 0.33, 0.66)
PURPLE: Color = (0.48, 0.26, 0.58)
CREAM: Color = (0.90, 0.86, 0.76)
BROWN: Color = (0.42, 0.27, 0.16)
BLACK: Color = (0.10, 0.10, 0.11)
CLEAR: Color = (0.80, 0.90, 0.88)
STEEL: Color = (0.80, 0.82, 0.85)


def matte(color: Color, gloss: float = 0.0) -> Material:
    """Paint of one colour."""
    return Material(Plain(color), gloss=gloss)


def glass(tint: Color = CLEAR, opacity: float = 0.16) -> Material:
    """A thin pane with a soft highlight."""
    return Material(Plain(tint, grain=0.0), "glass", gloss=0.5, opacity=opacity)


def mirror(tint: Color = STEEL, reflectance: float = 0.8) -> Material:
    """Polished metal with a glare."""
    return Material(Plain(tint, grain=0.0), "mirror", gloss=0.55, reflectance=reflectance)
