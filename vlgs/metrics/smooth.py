"""Sliding means and votes over a map, with the windows and the treatment of borders of the published evaluation codes."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad


def box_mean(maps: Float[Tensor, "b h w"], size: int) -> Float[Tensor, "b h w"]:
    """Mean over a square window, as OpenCV's ``filter2D`` with its default anchor and border.

    The window of an even size s reaches from -s/2 to s/2 - 1; the border mirrors without repeating the edge. Summed areas in
    float64 make the cost independent of the size; rounding back to the input's precision restores the ties of equal windows.

    Example:
        >>> box_mean(torch.tensor([[[1.0, 2.0, 3.0, 4.0, 5.0]]]), 4)
        tensor([[[2.0000, 2.0000, 2.5000, 3.5000, 4.0000]]])
    """
    return _window_mean(_window_mean(maps.double(), size, -1), size, -2).to(maps.dtype)


def pool_mean(maps: Float[Tensor, "b h w"], size: int) -> Float[Tensor, "b h w"]:
    """Mean over a centred square window of odd size; cells beyond the border do not count (LangSplatV2)."""
    return (_window_sum(maps.double(), size) / _window_area(maps, size)).to(maps.dtype)


def majority_vote(mask: Bool[Tensor, "h w"], size: int) -> Bool[Tensor, "h w"]:
    """Majority over a square window of odd size, ties to False, with LangSplat's edge.

    The released code clips the end of each window to ``h - 1`` and ``w - 1`` exclusively, so the last row and column never
    vote. That is kept: it is part of every published number.
    """
    h, w = mask.shape
    if h < 2 or w < 2:
        return torch.zeros_like(mask)  # nobody votes
    voters = mask.to(torch.int32)
    voters[-1], voters[:, -1] = 0, 0
    votes = _window_sum(voters[None], size)[0]
    return 2 * votes > _window_area(voters, size, clipped=1)


def pool_vote(mask: Bool[Tensor, "h w"], size: int) -> Bool[Tensor, "h w"]:
    """Majority over a centred square window of odd size, ties to False; every pixel votes (LangSplatV2)."""
    votes = _window_sum(mask.to(torch.int32)[None], size)[0]
    return 2 * votes > _window_area(votes[None], size)


def erode(mask: Bool[Tensor, "h w"], distance: int) -> Bool[Tensor, "h w"]:
    """Pixels all of whose neighbours within `distance` (chessboard) are set; what lies outside the image is not."""
    size = 2 * distance + 1
    return _window_sum(mask.to(torch.int32)[None], size)[0] == size * size


def _window_sum(maps: Tensor, size: int) -> Tensor:
    """Sum over a centred window of odd size; what lies outside counts as 0."""
    for dim in (-1, -2):
        first, last = _window(maps.shape[dim], size)
        sums = _summed(maps, dim)
        maps = sums.index_select(dim, last) - sums.index_select(dim, first)
    return maps


def _window_area(maps: Tensor, size: int, clipped: int = 0) -> Int[Tensor, "h w"]:
    """Cells of each window that lie inside the map, less `clipped` rows and columns at its end."""
    h, w = maps.shape[-2:]
    sides = []
    for n in (h, w):
        first, last = _window(n, size)
        sides.append(last.clamp_max(n - clipped) - first.clamp_max(n - clipped))
    return sides[0][:, None] * sides[1]


def _window(n: int, size: int) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    at, half = torch.arange(n), size // 2
    return (at - half).clamp_min(0), (at + half + 1).clamp_max(n)


def _window_mean(maps: Float[Tensor, "b h w"], size: int, dim: int) -> Float[Tensor, "b h w"]:
    n = maps.shape[dim]
    index = torch.arange(-(size // 2), n + (size - 1) // 2)
    period = max(2 * (n - 1), 1)  # mirrored as often as needed, so that windows may exceed the map
    index = index.remainder(period)
    index = torch.minimum(index, period - index).clamp_max(n - 1)
    sums = _summed(maps.index_select(dim, index), dim)
    return (sums.narrow(dim, size, n) - sums.narrow(dim, 0, n)) / size


def _summed(maps: Tensor, dim: int) -> Tensor:
    """Running sums with a leading 0."""
    before = (1, 0) if dim == -1 else (0, 0, 1, 0)
    return pad(maps.cumsum(dim, dtype=maps.dtype), before)
