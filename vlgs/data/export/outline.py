"""Masks as polygons, the way LERF-OVS stores them."""

import numpy as np
from jaxtyping import Bool, Int

_AROUND = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
"""The eight neighbours (x, y), clockwise as seen in an image, from the right one on."""


def outlines(mask: Bool[np.ndarray, "h w"]) -> list[Int[np.ndarray, "p 2"]]:
    """Outer boundary of every 8-connected component, as (x, y) corners that are pixels of the mask.

    Filled with its outline included, a polygon gives back its component with holes closed. Components come in order of
    their topmost, then leftmost pixel, and every polygon has at least three corners.
    """
    left = np.pad(mask, 1)
    found = []
    while left.any():
        y, x = divmod(int(left.argmax()), left.shape[1])
        found.append(_corners(_walk(left, x, y)) - 1)
        _erase(left, x, y)
    return found


def _walk(mask: Bool[np.ndarray, "h w"], x: int, y: int) -> list[tuple[int, int]]:
    """Moore's boundary walk from the topmost leftmost pixel of a component; the border of the array must be empty."""
    path = [(x, y)]
    came = 4  # as if from the left, where there is nothing
    first = None
    while True:
        for turn in range(1, 9):
            step = (came + turn) % 8
            to = (x + _AROUND[step][0], y + _AROUND[step][1])
            if mask[to[1], to[0]]:
                break
        else:
            return path
        # The walk is closed when it leaves its first pixel by its first step again: the pixel alone may be a bridge.
        if first == (x, y, step):
            return path[:-1]
        first = first or (x, y, step)
        x, y = to
        path.append(to)
        came = (step + 4) % 8


def _corners(path: list[tuple[int, int]]) -> Int[np.ndarray, "p 2"]:
    """Drop what lies on a straight run between two others; pad to three corners."""
    points = np.array(path, np.int64)
    if len(points) > 2:
        before, after = points - np.roll(points, 1, 0), np.roll(points, -1, 0) - points
        points = points[(before != after).any(1)]
    return np.concatenate([points, np.repeat(points[-1:], max(3 - len(points), 0), 0)])


def _erase(mask: Bool[np.ndarray, "h w"], x: int, y: int) -> None:
    """Clear the component of a pixel, in place."""
    stack = [(x, y)]
    mask[y, x] = False
    while stack:
        x, y = stack.pop()
        for dx, dy in _AROUND:
            if mask[y + dy, x + dx]:
                mask[y + dy, x + dx] = False
                stack.append((x + dx, y + dy))
