"""A part of a thing as a scene file writes it: a shape, a material and a pose (conf/data/README.md)."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal

from vlgs.data.synthetic.objects import Material, Part, turn
from vlgs.data.synthetic.patterns import (
    Bands,
    Cells,
    Color,
    Gradient,
    Pattern,
    Plain,
    Sectors,
    Wood,
)
from vlgs.data.synthetic.shapes import (
    Box,
    Revolution,
    Torus,
    cone,
    cylinder,
    ellipsoid,
    sphere,
    turned,
)
from vlgs.data.untrusted.nodes import Node

Colors = Mapping[str, Color]
"""Colours that have a name."""
Reader = Callable[[Node, Colors], Any]
"""Reads one argument."""
Makers = Mapping[str, tuple[Callable[..., Any], Mapping[str, Reader]]]
"""Word -> what makes it, and readers of the arguments. Whoever makes it says in a ValueError what it must be."""


def read_part(node: Node, colors: Colors) -> Part:
    """The part that an entry describes.

    Raises:
        SceneError: If it describes none.
    """
    entries = node.entries((*_SHAPES, *_MATERIALS, "center", "turn"))
    shape, material = (_made(node, entries, makers, colors) for makers in (_SHAPES, _MATERIALS))
    part = Part(shape, material)
    if "center" in entries:
        x, y, z = entries["center"].numbers(3, -1, 1)
        part = replace(part, center=(x, y, z))
    if "turn" in entries:
        axes = entries["turn"].entries(_AXES)
        if len(axes) != 1:
            raise entries["turn"].wrong("a turn about one axis")
        for axis in _AXES:
            if (degrees := axes.get(axis)) is not None:
                part = replace(part, rotation=turn(axis, degrees.number(-360, 360)))
    return part


def read_color(node: Node, colors: Colors) -> Color:
    """A colour, by its name or its shares of red, green and blue.

    Raises:
        SceneError: If it is neither.
    """
    if isinstance(node.value, str):
        return colors[node.option(colors)]
    red, green, blue = node.numbers(3, 0, 1)
    return red, green, blue


def _made(node: Node, entries: Mapping[str, Node], makers: Makers, colors: Colors) -> Any:
    """What the one of these words that stands there makes."""
    words = [word for word in entries if word in makers]
    if len(words) != 1:
        raise node.wrong(f"a mapping with one of the keys {', '.join(makers)}", words)
    return _make(entries[words[0]], *makers[words[0]], colors)


def _make(
    node: Node, make: Callable[..., Any], readers: Mapping[str, Reader], colors: Colors
) -> Any:
    parameters = inspect.signature(make).parameters.values()
    needed = [p.name for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    given = node.entries(readers, needed)
    arguments = {key: readers[key](value, colors) for key, value in given.items()}
    try:
        return make(**arguments)
    except ValueError as error:
        raise node.wrong(str(error)) from None


def _number(least: int | float, most: int | float) -> Reader:
    return lambda node, _: node.number(least, most)


def _numbers(least: int | float, most: int | float) -> Reader:
    return lambda node, _: node.numbers(3, least, most)


def _flag(node: Node, _: Colors) -> bool:
    return node.flag()


def _several(node: Node, colors: Colors) -> tuple[Color, ...]:
    return tuple(read_color(item, colors) for item in node.items(1, 30))


def _cone(bottom: float, top: float, height: float, open_top: bool = False) -> Revolution:
    if bottom == top == 0:
        raise ValueError("a cone with a radius above 0 at one end")
    return cone(bottom, top, height, open_top=open_top)


def _torus(major: float, minor: float) -> Torus:
    if minor > major:
        raise ValueError("a torus whose tube (minor) is no thicker than its ring (major)")
    return Torus(major, minor)


def _turned(
    heights: tuple[float, float, float],
    radii: tuple[float, float, float],
    closed_low: bool = True,
    closed_high: bool = True,
) -> Revolution:
    low, middle, high = heights
    if not (low + _THINNEST <= middle <= high - _THINNEST) or max(radii) == 0:
        raise ValueError("turned at rising heights, with a radius above 0")
    return turned(heights, radii, closed_low=closed_low, closed_high=closed_high)


def _gradient(low: Color, high: Color, start: float, end: float) -> Gradient:
    if end < start + _THINNEST:
        raise ValueError("a gradient that ends above its start")
    return Gradient(low, high, start, end)


def _matte(gloss: float = 0.0, **pattern: Pattern) -> Material:
    if len(pattern) != 1:
        raise ValueError(f"matte with one of the keys color, {', '.join(_PATTERNS)}")
    return Material(next(iter(pattern.values())), gloss=gloss)


def _glass(color: Color = (0.80, 0.90, 0.88), opacity: float = 0.16) -> Material:
    """A thin pane with a soft highlight."""
    return Material(Plain(color, grain=0.0), "glass", gloss=0.5, opacity=opacity)


def _mirror(color: Color = (0.80, 0.82, 0.85), reflectance: float = 0.8) -> Material:
    """Polished metal with a glare."""
    return Material(Plain(color, grain=0.0), "mirror", gloss=0.55, reflectance=reflectance)


_AXES: tuple[Literal["x", "y", "z"], ...] = ("x", "y", "z")
_THINNEST = 0.001
_LENGTH, _RADIUS, _HEIGHT = _number(_THINNEST, 0.5), _number(0, 0.5), _number(-1, 1)
_SHARE, _FEATURE = _number(0, 1), _number(0.005, 10)

_SHAPES: Makers = {
    "sphere": (sphere, {"radius": _LENGTH}),
    "ellipsoid": (ellipsoid, {"radius": _LENGTH, "half_height": _LENGTH}),
    "cylinder": (cylinder, {"radius": _LENGTH, "height": _LENGTH, "open_top": _flag}),
    "cone": (_cone, {"bottom": _RADIUS, "top": _RADIUS, "height": _LENGTH, "open_top": _flag}),
    "box": (Box, {"half": _numbers(_THINNEST, 0.5)}),
    "torus": (_torus, {"major": _LENGTH, "minor": _LENGTH}),
    "turned": (
        _turned,
        {
            "heights": _numbers(-0.5, 0.5),
            "radii": _numbers(0, 0.5),
            "closed_low": _flag,
            "closed_high": _flag,
        },
    ),
}
_PATTERNS: Makers = {
    "plain": (Plain, {"color": read_color, "grain": _SHARE, "scale": _FEATURE}),
    "gradient": (
        _gradient,
        {"low": read_color, "high": read_color, "start": _HEIGHT, "end": _HEIGHT},
    ),
    "bands": (
        Bands,
        {"colors": _several, "period": _FEATURE, "start": _HEIGHT, "scale": _FEATURE},
    ),
    "sectors": (Sectors, {"colors": _several}),
    "cells": (Cells, {"colors": _several, "size": _numbers(0.005, 10), "grain": _SHARE}),
    "wood": (Wood, {"light": read_color, "dark": read_color, "scale": _FEATURE}),
}
_MATERIALS: Makers = {
    "matte": (
        _matte,
        {
            "gloss": _SHARE,
            "color": lambda node, colors: Plain(read_color(node, colors)),
            **{
                word: lambda node, colors, maker=maker: _make(node, *maker, colors)
                for word, maker in _PATTERNS.items()
            },
        },
    ),
    "glass": (_glass, {"color": read_color, "opacity": _SHARE}),
    "mirror": (_mirror, {"color": read_color, "reflectance": _SHARE}),
}
