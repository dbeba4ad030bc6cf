"""What scenes are made of: a thing has a name in everyday words and parts; a part is a shape, a material and a pose."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from vlgs.data.synthetic.patterns import Pattern
from vlgs.data.synthetic.shapes import Shape

TRANSLUCENT_REFLECTIVE = "translucent_reflective"
OTHER = "other"


@dataclass(frozen=True)
class Material:
    """How a surface answers light."""

    pattern: Pattern
    kind: Literal["matte", "glass", "mirror", "light"] = "matte"
    """Which shading is used. A ``light`` is as bright as its pattern, without any other light on it."""
    gloss: float = 0.0
    """Strength of the highlight, which moves with the viewer."""
    opacity: float = 1.0
    """Glass only: how much a pane hides when seen face on; edges hide more."""
    reflectance: float = 0.0
    """Mirror only: share of the mirrored room in the colour."""


@dataclass(frozen=True)
class Part:
    """One surface of a thing, posed in the frame of the thing and later in that of the world."""

    shape: Shape
    material: Material
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[tuple[float, float, float], ...] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )
    """Part to thing; rows."""


@dataclass(frozen=True)
class Thing:
    """One object, or one background surface, standing on z = 0."""

    name: str
    """The class: what one would ask for."""
    parts: tuple[Part, ...]
    kind: str = OTHER
    """`TRANSLUCENT_REFLECTIVE` or `OTHER`."""
    background: bool = False
    """Table, walls and floor: every pixel has a class, but these are not asked for."""
    masked: bool = True
    """Off: no segmenter finds it and it is no class, as the sky."""


def turn(axis: Literal["x", "y", "z"], degrees: float) -> tuple[tuple[float, float, float], ...]:
    """Rotation about one axis, as rows."""
    cos, sin = float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))
    if axis == "x":
        return (1.0, 0.0, 0.0), (0.0, cos, -sin), (0.0, sin, cos)
    if axis == "y":
        return (cos, 0.0, sin), (0.0, 1.0, 0.0), (-sin, 0.0, cos)
    return (cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)


def place(thing: Thing, x: float, y: float, degrees: float) -> Thing:
    """The thing turned about its vertical axis and moved to (x, y) on the table."""
    yaw = np.array(turn("z", degrees))
    parts = []
    for part in thing.parts:
        center = yaw @ np.array(part.center) + (x, y, 0.0)
        rotation = yaw @ np.array(part.rotation)
        parts.append(
            replace(part, center=_triple(center), rotation=tuple(_triple(row) for row in rotation))
        )
    return replace(thing, parts=tuple(parts))


def _triple(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
