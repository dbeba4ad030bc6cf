"""The lamp of a scene: a round one, so that shadows have soft edges."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Rows = tuple[tuple[float, float, float], ...]

VERSION = 1
"""Part of the fingerprint of scenes with a lamp or an exposure of their own; raise it with any change that moves one of their pixels."""

_RAYS = 24


@dataclass(frozen=True)
class Light:
    """A disc that shines on all that faces its middle, and light that comes from everywhere."""

    center: tuple[float, float, float]
    """In metres."""
    radius: float
    power: float = 0.55
    """What it adds to a white surface that faces it."""
    ambient: float = 0.50
    """Brightness of a white upright surface in its shadow; one that looks up has 0.1 more."""
    axes: Rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Rotation of the disc, which looks down the third column; by default it is level."""
    on_things: bool = False
    """Whether its shadows fall on everything, or on the table's top and the floor alone."""

    def points(self) -> Float[np.ndarray, "s 3"]:
        """A sunflower of points on the disc: even, and without a random draw."""
        ray = np.arange(_RAYS)
        radius, angle = self.radius * np.sqrt((ray + 0.5) / _RAYS), 2.39996 * ray
        flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(_RAYS)])
        return np.array(self.center) + np.einsum("ij,js->si", np.array(self.axes), flat)


def light_on_table(
    center: tuple[float, float, float], radius: float, power: float, ambient: float
) -> Light:
    """A lamp that looks at the middle of the table, and whose shadows fall on everything."""
    away = np.array(center) / np.linalg.norm(center)
    across = np.cross((0.0, 0.0, 1.0), away)
    length = np.linalg.norm(across)
    across = across / length if length > 1e-6 else np.array((1.0, 0.0, 0.0))
    columns = np.stack([across, np.cross(away, across), away], axis=1)
    axes = tuple((x, y, z) for x, y, z in columns.tolist())
    return Light(center, radius, power, ambient, axes, on_things=True)
