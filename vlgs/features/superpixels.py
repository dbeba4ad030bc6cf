"""A segmenter without weights: superpixels at three sizes (Achanta et al., TPAMI 2012, with 3x3 neighbouring centres)."""

from collections.abc import Mapping, Sequence

import kornia
import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from vlgs.features.masks import Mask, crop_mask


class Superpixels:
    """Regions of even colour, a fixed number along the longer side, as masks of the levels s, m and l; default has all.

    They follow edges but know nothing of objects: for a trial where SAM's weights are not at hand, and as the baseline that
    masks of a model must beat.

    Args:
        per_side: Superpixels along the longer side, at the levels s, m and l.
        compactness: Weight of distance against colour; near 0 follows colour, large gives squares.
        rounds: Passes of assignment and update.

    Raises:
        ValueError: If a count is not positive or `compactness` negative.
    """

    def __init__(
        self, per_side: Sequence[int] = (24, 12, 6), compactness: float = 10.0, rounds: int = 10
    ):
        if len(per_side) != 3 or min(*per_side, rounds) < 1:
            raise ValueError(
                f"features: per_side must be three positive numbers and rounds one, got {list(per_side)} and {rounds}"
            )
        if not compactness >= 0:
            raise ValueError(f"features: compactness must not be negative, got {compactness}")
        self.per_side = tuple(per_side)
        self.compactness = compactness
        self.rounds = rounds

    def identity(self) -> Mapping[str, str]:
        """Nothing was read."""
        return {}

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> Sequence[Sequence[Mask]]:
        """See `vlgs.features.Segmenter`."""
        planes = torch.from_numpy(image.copy()).permute(2, 0, 1)[None].float() / 255
        lab = kornia.color.rgb_to_lab(planes)[0].permute(1, 2, 0)
        levels = [masks_of(slic(lab, n, self.compactness, self.rounds)) for n in self.per_side]
        # Coarse first, so that what is painted last and stays are the fine ones.
        return [[m for level in reversed(levels) for m in level], *levels]


def slic(
    lab: Float[Tensor, "h w 3"], per_side: int, compactness: float, rounds: int
) -> Int64[Tensor, "h w"]:
    """The superpixel of every pixel: k-means over colour and place, each pixel among the centres of the 3x3 cells around it.

    Args:
        lab: CIELAB colours.
        per_side: Cells along the longer side.
        compactness: Weight of place, where one cell's length counts as much as this distance in colour.
        rounds: Passes.
    """
    height, width = lab.shape[:2]
    cell = max(1.0, max(height, width) / per_side)
    rows, columns = max(1, round(height / cell)), max(1, round(width / cell))
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    place = torch.stack([y, x], dim=-1) * (compactness / cell)
    points = torch.cat([lab, place], dim=-1).reshape(-1, 5)
    row, column = (y * rows // height).flatten(), (x * columns // width).flatten()
    own = row * columns + column
    for _ in range(rounds):
        centres, counts = torch.zeros(rows * columns, 5), torch.zeros(rows * columns)
        centres.index_add_(0, own, points)
        counts.index_add_(0, own, torch.ones(len(own)))
        centres = centres / counts.clamp(min=1)[:, None]
        centres[counts == 0] = torch.inf
        best = torch.full((len(own),), torch.inf)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                near = (row + dy).clamp(0, rows - 1) * columns + (column + dx).clamp(0, columns - 1)
                distance = (points - centres[near]).square().sum(dim=1)
                closer = distance < best
                best = torch.where(closer, distance, best)
                own = torch.where(closer, near, own)
    return own.reshape(height, width)


def masks_of(ids: Int64[Tensor, "h w"]) -> list[Mask]:
    """A mask for each id that occurs, rising."""
    array = ids.numpy()
    found = []
    order = np.argsort(array, axis=None, kind="stable")
    bounds = np.flatnonzero(np.diff(array.ravel()[order])) + 1
    for members in np.split(order, bounds):
        y, x = np.divmod(members, array.shape[1])
        pixels = np.zeros((np.ptp(y) + 1, np.ptp(x) + 1), bool)
        pixels[y - y.min(), x - x.min()] = True
        mask = crop_mask(pixels, int(x.min()), int(y.min()))
        assert mask is not None
        found.append(mask)
    return found
