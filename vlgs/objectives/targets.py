"""The training views as what they should look like: photographs, language codes, and how similar two views are."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.data.cache import PixelCache
from vlgs.data.sampler import PairSampler
from vlgs.losses import view_similarity
from vlgs.skip_count import SkipCount
from vlgs.types import Scene, View

TARGET_BYTES = 256 << 20
"""Most bytes of float32 images and code maps that are kept for the losses. If all views need more, those of one iteration are kept."""


@dataclass(frozen=True)
class Target:
    """What one training view should look like; its tensors are shared between iterations."""

    view: View
    image: Float[Tensor, "h w 3"]
    codes: Float[Tensor, "h wl t"] | None
    """What pixels should show of language (`vlgs.heads.Head.targets`), mostly codes. With ``levels=joint`` those of the l mask levels of
    a pixel stand beside each other in its row, so that losses and blending need not know of levels."""
    valid: Bool[Tensor, "h wl"] | None
    """Where there is a mask; None like `codes` where the view has no language."""


class TrainingViews:
    """The training views of a scene, in the pairs in which an iteration sees them.

    Args:
        scene: With at least one training view.
        codes: Target of every mask, [m, t]; m = 0 without language.
        sampler: Which views an iteration sees.
        counts: Where similarities that are known already are counted.
    """

    def __init__(
        self, scene: Scene, codes: Float[Tensor, "m t"], sampler: PairSampler, counts: SkipCount
    ) -> None:
        self.scene = scene
        self.has_language = len(codes) > 0
        self.sampler = sampler
        self.counts = counts
        self.similarities: dict[tuple[int, int], float] = {}
        # "No mask" is -1, which indexes the last row, a zero code.
        self._codes = torch.cat([codes, torch.zeros(1, codes.shape[1])])
        self.cache = PixelCache(self._room())

    def __getitem__(self, index: int) -> Target:
        """A training view by its place in the scene."""
        view, kept = self.scene.train[index], self.cache
        image = kept.get((index, "image"), lambda: view.read_image().to(torch.float32).div_(255.0))
        if view.read_masks is None or not self.has_language:
            return Target(view, image, None, None)
        read = view.read_masks
        # With l mask levels, each pixel becomes l neighbours in its row.
        codes = kept.get((index, "codes"), lambda: self._codes[read().long()].flatten(1, -2))
        valid = kept.get((index, "valid"), lambda: (read() >= 0).flatten(1))
        return Target(view, image, codes, valid)

    def similarity(self, first: int, second: int) -> float:
        """SSIM(I1, I2), clamped at 0, computed once per pair (conf/README.md, D.12)."""
        pair = (min(first, second), max(first, second))
        if pair in self.similarities:
            self.counts.skip("similarity_cache")
        else:
            with self.counts.doing("similarity"):
                self.similarities[pair] = view_similarity(*(self[i].image for i in pair))
        return self.similarities[pair]

    def _room(self) -> int:
        """Bytes for cached targets: all views if they fit, else the two views of one iteration. Caching some of the views would rarely help."""
        code = 4 * self._codes.shape[1] + 1  # and whether it counts
        pixel = 3 * 4 + (code * self.scene.mask_levels if self.has_language else 0)
        views = [pixel * view.camera.width * view.camera.height for view in self.scene.train]
        return sum(views) if sum(views) <= TARGET_BYTES else 2 * max(views)


def covered(view: View) -> Bool[Tensor, "h w"] | None:
    """Pixels that the photograph of a view covers; None for all."""
    return None if view.read_valid is None else view.read_valid()
