"""What a surface looks like before light falls on it: a colour and a patch number for every local point.

A patch is a piece of one colour that a segmenter would find inside a part, such as one stripe of a mug; patches are the
`subpart` level of the language supervision.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt16

Color = tuple[float, float, float]
Painted = tuple[Float[np.ndarray, "3 n"], UInt16[np.ndarray, " n"]]
"""Colour in [0, 1] and patch number per point."""


@runtime_checkable
class Pattern(Protocol):
    """Colour of a surface as a function of where on the surface."""

    def __call__(self, point: Float[np.ndarray, "3 n"]) -> Painted:
        """Paint points that are given in the frame of the part, in metres."""
        ...


def _grain(point: Float[np.ndarray, "3 n"], scale: float) -> Float[np.ndarray, " n"]:
    """Smooth unevenness in [-1, 1] with features of about `scale` metres: two crossed waves, bent by each other."""
    x, y, z = point * (2 * np.pi / scale)
    return 0.5 * (
        np.sin(x + 0.7 * z + 1.3 * np.sin(0.6 * y)) + np.sin(y - 0.8 * z + 0.9 * np.sin(0.5 * x))
    )


def _pick(colors: tuple[Color, ...], index: np.ndarray) -> Float[np.ndarray, "3 n"]:
    return np.array(colors).T[:, index.astype(np.intp) % len(colors)]


@dataclass(frozen=True)
class Plain:
    """One colour, slightly uneven so that the surface can be found in images."""

    color: Color
    grain: float = 0.06
    """Amplitude of the unevenness, relative."""
    scale: float = 0.09
    """Its feature size in metres."""

    def __call__(self, point: Float[np.ndarray, "3 n"]) -> Painted:
        """See `Pattern`."""
        shade = np.ones(point.shape[1])
        if self.grain:
            shade += self.grain * _grain(point, self.scale)
        return np.array(self.color)[:, None] * shade, np.zeros(point.shape[1], np.uint16)


@dataclass(frozen=True)
class Gradient:
    """From one colour to another along the z axis, with nothing to hold on to; one patch."""

    low: Color
    high: Color
    start: float
    """Height up to which the first colour is pure."""
    end: float
    """Height from which the second one is."""

    def __call__(self, point: Float[np.ndarray, "3 n"]) -> Painted:
        """See `Pattern`."""
        share = np.clip((point[2] - self.start) / (self.end - self.start), 0.0, 1.0)
        share = share * share * (3 - 2 * share)  # without an edge at either end
        low, high = np.array(self.low)[:, None], np.array(self.high)[:, None]
        return low + (high - low) * share, np.zeros(point.shape[1], np.uint16)


@dataclass(frozen=True)
class Bands:
    """Stripes across the z axis, from `start` upwards; what lies below belongs to the first."""

    colors: tuple[Color, ...]
    period: float
    start: float = 0.0
    scale: float = 0.09
    """Feature size of the unevenness in metres."""

    def __call__(self, point: Float[np.ndarray, "3 n"]) -> Painted:
        """See `Pattern`."""
        band = np.clip(np.floor((point[2] - self.start) / self.period), 0, 30).astype(np.uint16)
        return _pick(self.colors, band) * (1 + 0.04 * _grain(point, self.scale)), band


@dataclass(frozen=True)
class Sectors:
    """Slices around the z axis, like those of a beach ball."""

    colors: tuple[Color, ...]

    def __call__(self, point: Float[np.ndarray, "3 n"]) -> Painted:
        """See `Pattern`."""
        turn = np.arctan2(point[1], point[0]) / (2 * np.pi) + 0.5
        sector = np.minimum(turn * len(self.colors), len(self.colors) - 1).astype(np.uint16)
        return _pick(self.colors, sector), sector


@dataclass(frozen=True)
class Cells:
    """Cells of a grid that is centred on the origin, coloured so that neighbours differ."""

    colors: tuple[Color, ...]
    size: tuple[float, float, float]
    """Edges of a cell in metres."""
    grain: float = 0.04

    def __call__(self, point: Float[np.ndarray, "3 n"]) -> Painted:
        """See `Pattern`."""
        # A surface that lies exactly on a cell border is drawn a hair inwards, or rounding would speckle it.
        i, j, k = np.floor(point * 0.999 / np.array(self.size)[:, None] + 0.5)
        # Five bits for each: cells farther out than the sixteenth share a number.
        a, b, c = (np.clip(n, -16, 15) + 16 for n in (i, j, k))
        patch = (a * 32 + b) * 32 + c
        color = _pick(self.colors, i + 2 * j + 3 * k + 60)
        return color * (1 + self.grain * _grain(point, 0.5)), patch.astype(np.uint16)


@dataclass(frozen=True)
class Wood:
    """Two browns in soft wavy bands along the y axis; one patch."""

    light: Color
    dark: Color
    scale: float

    def __call__(self, point: Float[np.ndarray, "3 n"]) -> Painted:
        """See `Pattern`."""
        x, y, z = point * (2 * np.pi / self.scale)
        share = 0.5 + 0.5 * np.sin(x + 0.8 * np.sin(0.23 * y) + 0.5 * z + 0.4 * np.sin(0.37 * x))
        light, dark = np.array(self.light)[:, None], np.array(self.dark)[:, None]
        return light + (dark - light) * share, np.zeros(point.shape[1], np.uint16)
