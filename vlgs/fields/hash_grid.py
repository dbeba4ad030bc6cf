"""Multiresolution hash grids: features of points in the unit cube (Mueller et al., *Instant Neural Graphics Primitives*, 2022)."""

from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

from vlgs.ops.row_sums import row_sums_backward
from vlgs.values import require_fields, require_range

_PRIMES = (1, 2654435761, 805459861)
"""Instant-NGP's, one for each axis."""
_START = 1e-4
"""Features begin uniform in [-1e-4, 1e-4], as in Instant-NGP."""


@dataclass(frozen=True)
class GridConfig:
    """A stack of grids over the unit cube, whose resolutions grow by one factor.

    Raises:
        ValueError: If a number is out of range.
    """

    levels: int
    """Number of grids."""
    features: int
    """Numbers that each grid gives for a point."""
    coarsest: int
    """Cells along an axis of the first grid."""
    finest: int
    """Cells along an axis of the last grid."""
    log2_table: int
    """A grid of more than 2^log2_table corners shares so many rows among them, by a hash of their places."""

    def __post_init__(self) -> None:
        require_fields("hash grid", self)
        require_range("hash grid", 1, 64, levels=self.levels, features=self.features)
        require_range("hash grid", 1, 1 << 20, coarsest=self.coarsest)
        require_range("hash grid", self.coarsest, 1 << 20, finest=self.finest)
        require_range("hash grid", 4, 24, log2_table=self.log2_table)

    @property
    def width(self) -> int:
        """Numbers that all grids together give for a point."""
        return self.levels * self.features

    @property
    def resolutions(self) -> list[int]:
        """Cells along an axis of each grid.

        Example:
            >>> GridConfig(3, 2, 16, 64, 15).resolutions
            [16, 32, 64]
        """
        growth = (self.finest / self.coarsest) ** (1 / max(1, self.levels - 1))
        return [int(self.coarsest * growth**level + 1e-6) for level in range(self.levels)]

    @property
    def rows(self) -> list[int]:
        """Rows that each grid has in the table."""
        return [min((cells + 1) ** 3, 1 << self.log2_table) for cells in self.resolutions]


class HashGrid(nn.Module):
    """Features that are interpolated between the eight corners of a point's cell, in each of several grids.

    Corners of a coarse grid have a row of the table each; those of a fine one share rows, by the hash
    ``x ^ 2654435761 y ^ 805459861 z mod 2^log2_table`` of their places.

    Args:
        config: The grids.
        generator: Draws the features of the start.
    """

    def __init__(self, config: GridConfig, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.config = config
        start = torch.rand(sum(config.rows), config.features, generator=generator)
        self.table = nn.Parameter(_START * (2 * start - 1))
        rows = torch.tensor(config.rows)
        self._resolutions = torch.tensor(config.resolutions)
        self._begins = rows.cumsum(0) - rows
        self._offsets = self._begins.int()[:, None]
        # Grids only grow, so that those with a row for each corner come first.
        self._dense = sum(
            (cells + 1) ** 3 <= 1 << config.log2_table for cells in config.resolutions
        )
        # 32-bit products wrap around, as the hash wants them.
        sizes = (self._resolutions + 1).int()
        self._steps = {prime: torch.full_like(sizes, _wrapped(prime))[:, None] for prime in _PRIMES}
        for axis, steps in enumerate(self._steps.values()):
            steps[: self._dense, 0] = sizes[: self._dense] ** axis

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n w"]:
        """Features of points in the unit cube; those beside it count as on its side. No gradient reaches the points."""
        with torch.no_grad():
            rows, weights = self.corners(points)
        return interpolate(self.table, rows, weights, self._begins)

    def corners(
        self, points: Float[Tensor, "n 3"]
    ) -> tuple[Int32[Tensor, "nl 8"], Float[Tensor, "nl 8"]]:
        """Rows of the table, and their shares, that make up each feature: point by point for each grid."""
        places = points.clamp(
            0, 1
        ).T.contiguous()  # [3, n]: long rows, which vector instructions like
        resolutions = self._resolutions.to(points)[:, None]
        shares, ends = [], []
        for place, prime in zip(places, _PRIMES, strict=True):
            scaled = place * resolutions  # [l, n]
            low = torch.minimum(scaled.floor(), resolutions - 1)
            share = scaled - low
            shares.append((1 - share, share))
            ends.append(self._ends(low.int(), prime))
        rows, weights = [], []
        for x, y, z in product((0, 1), repeat=3):
            rows.append(self._rows(ends[0][x], ends[1][y], ends[2][z]))
            weights.append(shares[0][x] * shares[1][y] * shares[2][z])
        return torch.stack(rows, dim=-1).flatten(0, 1), torch.stack(weights, dim=-1).flatten(0, 1)

    def _ends(self, low: Int32[Tensor, "l n"], prime: int) -> tuple[Tensor, Tensor]:
        """What both ends of a cell along one axis add to the number of a row."""
        step = self._steps[prime]
        first = low * step
        return first, first + step

    def _rows(self, x: Tensor, y: Tensor, z: Tensor) -> Int32[Tensor, "l n"]:
        """Rows of corners, whose numbers along the axes are added up in coarse grids and hashed in fine ones."""
        d = self._dense
        rows = torch.empty_like(x)
        torch.add(x[:d] + y[:d], z[:d], out=rows[:d])
        torch.bitwise_and(x[d:] ^ y[d:] ^ z[d:], (1 << self.config.log2_table) - 1, out=rows[d:])
        return rows.add_(self._offsets)


def interpolate(
    table: Float[Tensor, "r f"],
    rows: Int32[Tensor, "nl 8"],
    weights: Float[Tensor, "nl 8"],
    begins: Int64[Tensor, " l"] | None = None,
) -> Float[Tensor, "n w"]:
    """Sums of eight weighted rows of a table, differentiable by the table alone.

    PyTorch's own gradient of `embedding_bag` sorts its rows and takes far longer than the sums of this one, which are
    added in the order of the points and therefore have the same bits for any number of threads.

    Args:
        table: The features of l grids.
        rows: Which ones, grid by grid.
        weights: What they count.
        begins: First row of each grid; None: there is one.
    """
    return _Interpolate.apply(
        table, rows, weights, rows.new_zeros(1).long() if begins is None else begins
    )


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weights: Tensor, begins: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights, begins)
        ctx.shape = table.shape
        sums = embedding_bag(rows, table, mode="sum", per_sample_weights=weights)
        return sums.view(len(begins), -1, table.shape[1]).transpose(0, 1).flatten(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        rows, weights, begins = ctx.saved_tensors
        count, features = ctx.shape
        d_sums = gradients[0].view(-1, len(begins), features)
        return row_sums_backward(begins, rows, weights, d_sums, count), None, None, None


def contract(points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """All of space in a ball of radius 2: as it is up to 1, and ``(2 - 1/|x|) x/|x|`` beyond (Barron et al., Mip-NeRF 360).

    Example:
        >>> contract(torch.tensor([[0.5, 0.0, 0.0], [4.0, 0.0, 0.0]]))
        tensor([[0.5000, 0.0000, 0.0000],
                [1.7500, 0.0000, 0.0000]])
    """
    length = torch.linalg.vector_norm(points, dim=-1, keepdim=True).clamp_min(1)
    return points * ((2 - 1 / length) / length)


def _wrapped(number: int) -> int:
    """A 32-bit number as the signed one of the same bits."""
    return number - (1 << 32) if number >= 1 << 31 else number
