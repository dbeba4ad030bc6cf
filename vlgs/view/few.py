"""A view asked at few of its pixels: those that stand for all that carry nearly the same code.

A word is compared with decoded codes, and decoding is what takes the time of a query. Objects are of one code almost everywhere, so that some thousand
pixels answer for hundreds of thousands. Which ones depends on the codes alone: it is found once for a camera, whatever words are asked.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields import Field, FieldImages
from vlgs.types import Camera

_WIDEST = 16
"""Numbers of a code up to which cells are tried; almost every pixel of wider ones is in a cell of its own."""
_CELLS = (64, 45, 32, 22, 16)
"""Cells along each number of a code, between its least and its greatest value in the view."""
_SAMPLE = 8
"""Every eighth pixel tells in short whether there are too many cells."""
_BAND = 1 << 14
"""Pixels that are asked before it is looked whether the answer is still wanted."""

Words = Float[Tensor, "k e"]


class Stale(Exception):  # noqa: N818 (nothing went wrong)
    """What is being drawn is no longer wanted."""


@dataclass(frozen=True)
class Few:
    """Pixels that stand for all."""

    pixels: Int[Tensor, " p"]
    """Counted row by row."""
    stands_in: Int[Tensor, "h w"]
    """For each pixel of the view, which of them answers for it."""


def few_pixels(codes: Float[Tensor, "h w d"], most: int) -> Few:
    """At most so many pixels, one for each cell of code space that the view has, with cells as small as they can be.

    Where even large cells are too many, they are pixels of a regular grid.
    """
    h, w, d = codes.shape
    flat = codes.flatten(0, 1)
    if d <= _WIDEST:
        low, high = flat.aminmax(dim=0)
        shares = (flat - low) / (high - low).clamp_min(1e-12)
        # Odd factors of 64 bits tell cells of any number of dimensions apart; that two share a sum has odds of 1e-9.
        factors = torch.randint(2**62, (d,), generator=torch.Generator().manual_seed(0)) * 2 + 1
        for cells in _CELLS:
            keys = ((shares * (cells - 1)).round().long() * factors).sum(dim=1)
            if len(keys[::_SAMPLE].unique()) > most:
                continue
            found, stands_in = keys.unique(return_inverse=True)
            if len(found) <= most:
                pixels = torch.empty_like(found)
                pixels[stands_in] = torch.arange(h * w)
                return Few(pixels, stands_in.view(h, w))
    return _grid(h, w, most)


def _grid(h: int, w: int, most: int) -> Few:
    step = 1
    while -(-h // step) * -(-w // step) > most:
        step += 1
    rows, columns = torch.arange(h) // step, torch.arange(w) // step
    across = int(columns[-1]) + 1
    corners = rows.unique()[:, None] * step * w + columns.unique() * step
    return Few(corners.flatten(), rows[:, None] * across + columns)


def ask_few(
    levels: Sequence[Field],
    camera: Camera,
    feature: Float[Tensor, "levels h w d"],
    few: Sequence[Few],
    words: Words,
) -> Float[Tensor, "levels k h w"]:
    """`Field.similarity` at few pixels of each mask level, and for all others what those say that stand for them."""
    answers = []
    for index, (level, own) in enumerate(zip(levels, few, strict=True)):
        seen = FieldImages(feature=feature[index : index + 1])
        found = level.similarity(camera, words, seen, own.pixels)[0, :, 0]
        answers.append(found[:, own.stands_in])
    return torch.stack(answers)


def ask_all(
    field: Field, camera: Camera, seen: FieldImages, words: Words, stale: Callable[[], bool]
) -> Float[Tensor, "levels k h w"]:
    """`Field.similarity` at every pixel, given up between bands of pixels where it is no longer wanted.

    Raises:
        Stale: If it is not.
    """
    every, bands = torch.arange(camera.height * camera.width), []
    for pixels in every.split(_BAND):
        if stale():
            raise Stale
        bands.append(field.similarity(camera, words, seen, pixels)[:, :, 0])
    return torch.cat(bands, dim=2).unflatten(2, (camera.height, camera.width))
