"""An extractor without a segmenter: overlapping tiles of several sizes, each with a vector (LERF, LEGaussians, FMGS)."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from vlgs.features.extractor import LEVELS, Encoder, MaskFeatures, encode
from vlgs.features.masks import Mask

Grid = Float32[np.ndarray, "_ _ e"]
"""A vector for each cell of an even grid over a photograph, by rows and columns."""


class TilePyramid:
    """Vectors of square tiles around the cells of a grid, averaged over tile sizes.

    A size has a grid whose cells are about `stride` of a tile apart, and an encoder sees the tile around the middle of each cell, moved into the
    photograph where it would reach beyond. A level of the language maps has the cells of its smallest tiles as masks. The vector of a cell is
    the mean over the level's sizes, those of other grids taken between the four nearest cells, at unit length.

    LEGaussians and FMGS are taught by the mean over all sizes, which is level 0. LERF is taught by each size, and a mask's area tells it which: that
    of a cell grows with its tiles.

    Args:
        encoder: What describes a tile.
        sides: Of tiles, rising, as shares of the photograph's shorter side; seven from 0.05 to 0.5 in all three programs.
        stride: From tile to tile, as a share of their side.
        levels: For each of the four levels the numbers of its sizes, from 0; none: the level holds nothing.

    Raises:
        ValueError: If a share is not above 0 and at most 1, sides do not rise, or levels are not four lists of sizes that there are.
    """

    def __init__(
        self,
        encoder: Encoder,
        sides: Sequence[float] = (0.05, 0.125, 0.2, 0.275, 0.35, 0.425, 0.5),
        stride: float = 0.5,
        levels: Sequence[Sequence[int]] = ((0, 1, 2, 3, 4, 5, 6), (0, 1), (2, 3, 4), (5, 6)),
    ):
        rising = all(a < b for a, b in pairwise(sides))
        if not sides or not rising or not all(0 < side <= 1 for side in (*sides, stride)):
            raise ValueError(
                f"features: sides must rise and, as stride, be above 0 and at most 1, got {list(sides)} and {stride}"
            )
        asked = {size for level in levels for size in level}
        if len(levels) != LEVELS or not asked or asked - set(range(len(sides))):
            raise ValueError(
                f"features: levels must be {LEVELS} lists of numbers of sides, 0 to {len(sides) - 1}, got {list(map(list, levels))}"
            )
        self.encoder = encoder
        self.sides = tuple(sides)
        self.stride = stride
        self.levels = tuple(tuple(sorted(set(level))) for level in levels)

    def identity(self) -> Mapping[str, str]:
        """That of the encoder.

        Raises:
            FileNotFoundError: If weights are missing.
        """
        return self.encoder.identity()

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], stem: str) -> MaskFeatures:
        """See `vlgs.features.Extractor`.

        Raises:
            ValueError: If the encoder's vectors are not finite, or zero, or their mean is.
        """
        size = (image.shape[0], image.shape[1])
        used = sorted({number for level in self.levels for number in level})
        grids = {number: self._grid(image, self.sides[number], stem) for number in used}
        ids = np.full((LEVELS, *size), -1, np.int32)
        found, count = [], 0
        for level, numbers in enumerate(self.levels):
            if not numbers:
                continue
            shape = grids[numbers[0]].shape[:2]
            mean = np.mean([resample(grids[number], shape) for number in numbers], axis=0)
            ids[level] = count + cells(size, shape)
            found.append(_unit(mean.reshape(-1, mean.shape[-1]), stem))
            count += len(found[-1])
        return MaskFeatures(ids, np.concatenate(found))

    def _grid(self, image: UInt8[np.ndarray, "h w 3"], share: float, stem: str) -> Grid:
        height, width, _ = image.shape
        side = max(1, round(share * min(height, width)))
        rows, columns = (math.ceil(n / (self.stride * side)) for n in (height, width))
        whole = np.ones((side, side), bool)
        tiles = [
            Mask(_start(x, columns, width, side), _start(y, rows, height, side), whole)
            for y in range(rows)
            for x in range(columns)
        ]
        return encode(self.encoder, image, tiles, stem).reshape(rows, columns, -1)


def cells(size: tuple[int, int], shape: tuple[int, int]) -> Int32[np.ndarray, "h w"]:
    """Number of the cell of an even grid that each pixel lies in, row by row.

    Args:
        size: Height and width of the photograph.
        shape: Rows and columns of the grid; cells differ by a pixel where it does not divide the size.
    """
    y, x = (
        ((np.arange(n) + 0.5) * m / n).astype(np.int32) for n, m in zip(size, shape, strict=True)
    )
    return y[:, None] * shape[1] + x


def resample(grid: Grid, shape: tuple[int, int]) -> Grid:
    """A grid at the middles of the cells of another one over the same photograph: bilinear, and beyond the outermost middles as there."""
    for axis, count in enumerate(shape):
        have = grid.shape[axis]
        place = ((np.arange(count) + 0.5) * have / count - 0.5).clip(0, have - 1)
        low = place.astype(int)
        high = np.minimum(low + 1, have - 1)
        part = (place - low).astype(np.float32)
        part = part[:, None, None] if axis == 0 else part[:, None]
        grid = grid.take(low, axis) * (1 - part) + grid.take(high, axis) * part
    return grid


def _start(cell: int, count: int, length: int, side: int) -> int:
    """First pixel of the tile around the middle of a cell, within the photograph."""
    return min(max(0, round((cell + 0.5) * length / count - side / 2)), length - side)


def _unit(vectors: Float32[np.ndarray, "m e"], stem: str) -> Float32[np.ndarray, "m e"]:
    norms = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not (norms > 0).all():
        raise ValueError(
            f"features: mean vectors of tiles of {stem} must not be zero, got {int((norms == 0).sum())} that are"
        )
    return (vectors / norms).astype(np.float32)
