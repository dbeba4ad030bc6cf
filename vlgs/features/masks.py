"""Masks that store only the pixels of their bounding box (a thousand of them take megabytes), and operations on them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32


@dataclass(frozen=True)
class Mask:
    """Some pixels of a photograph: a box, and which of its pixels belong."""

    x: int
    """Left column of the box."""
    y: int
    """Top row of the box."""
    pixels: Bool[np.ndarray, "bh bw"]
    """In the box; the first and last row and column each have a pixel that belongs."""

    @property
    def box(self) -> tuple[int, int, int, int]:
        """``(x1, y1, x2, y2)``, the last two exclusive."""
        height, width = self.pixels.shape
        return self.x, self.y, self.x + width, self.y + height

    @property
    def area(self) -> int:
        """Pixels that belong."""
        return int(self.pixels.sum())

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the box."""
        x1, y1, x2, y2 = self.box
        return slice(y1, y2), slice(x1, x2)

    @property
    def key(self) -> tuple[int, int, tuple[int, ...], bytes]:
        """Equal for equal masks."""
        return self.x, self.y, self.pixels.shape, np.packbits(self.pixels).tobytes()


def crop_mask(pixels: Bool[np.ndarray, "h w"], x: int = 0, y: int = 0) -> Mask | None:
    """A mask cut to its box; None if no pixel belongs to it.

    Args:
        pixels: Of a window of the photograph.
        x: Left column of the window.
        y: Top row of the window.
    """
    rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
    if not len(rows):
        return None
    inside = pixels[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Mask(x + int(columns[0]), y + int(rows[0]), inside.copy())


def paint(masks: Sequence[Mask], size: tuple[int, int]) -> Int32[np.ndarray, "h w"]:
    """Number of the mask that each pixel shows, the later over the earlier; -1 where there is none.

    Args:
        masks: In the order in which they are painted.
        size: Height and width.
    """
    ids = np.full(size, -1, np.int32)
    for number, mask in enumerate(masks):
        ids[mask.window][mask.pixels] = number
    return ids


def intersections(masks: Sequence[Mask], size: tuple[int, int]) -> Float64[np.ndarray, "m m"]:
    """Pixels that each pair of masks has in common, exactly.

    Pixels that lie in the same masks are counted together: each mask adds a random number to its pixels, and equal sums
    mean equal sets. Two different sets collide with a probability below (number of sets)^2 / 2^64. One pass over the boxes
    and a product with one column per set replace a pass over the image for each pair.

    Args:
        masks: Any number of them.
        size: Height and width of the photograph.
    """
    keys = np.random.default_rng(0).integers(1, 2**64, len(masks), np.uint64, endpoint=False)
    sums = np.zeros(size, np.uint64)
    for key, mask in zip(keys, masks, strict=True):
        sums[mask.window] += key * mask.pixels
    _, first, counts = np.unique(sums, return_index=True, return_counts=True)
    rows, columns = np.divmod(first, size[1])
    member = np.zeros((len(masks), len(first)))
    for i, mask in enumerate(masks):
        x1, y1, x2, y2 = mask.box
        near = np.flatnonzero((x1 <= columns) & (columns < x2) & (y1 <= rows) & (rows < y2))
        member[i, near] = mask.pixels[rows[near] - y1, columns[near] - x1]
    return (member * counts) @ member.T


def remove_small_regions(mask: Mask, size: tuple[int, int], least: int) -> tuple[Mask, bool]:
    """The mask without holes and islands of fewer than `least` pixels (8-connected), and whether that changed it.

    Holes are filled first. Where every island is small the largest stays.
    """
    top, left = min(mask.y, 1), min(mask.x, 1)
    _, _, x2, y2 = mask.box
    pads = ((top, int(y2 < size[0])), (left, int(x2 < size[1])))
    pixels = np.pad(mask.pixels, pads)  # one row more on each side: there the outside is connected
    ring = np.pad(np.zeros(mask.pixels.shape, bool), pads, constant_values=True)
    labels = _regions(~pixels)
    areas = np.bincount(labels.ravel())
    areas[np.unique(labels[ring])] = least  # goes on outside of the box
    areas[0] = least
    filled = pixels | (areas < least)[labels]
    labels = _regions(filled)
    areas = np.bincount(labels.ravel())
    large = areas >= least
    large[0] = False
    if not large.any():
        large[1 + areas[1:].argmax()] = True
    cleaned = large[labels]
    if np.array_equal(cleaned, pixels):
        return mask, False
    result = crop_mask(cleaned, mask.x - left, mask.y - top)
    assert result is not None
    return result, True


def _regions(pixels: Bool[np.ndarray, "h w"]) -> Int32[np.ndarray, "h w"]:
    """Numbers of the 8-connected regions, from 1; 0 elsewhere."""
    from scipy import ndimage

    labels = np.zeros(pixels.shape, np.int32)
    ndimage.label(pixels, np.ones((3, 3), bool), output=labels)
    return labels
