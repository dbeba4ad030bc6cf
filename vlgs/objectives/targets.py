"""The training views as what they should look like: photographs, language codes, and how similar two views are."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vlgs.data.cache import PixelCache
from vlgs.data.half_size import half_size
from vlgs.data.sampler import PairSampler
from vlgs.losses import view_similarity
from vlgs.skip_count import SkipCount
from vlgs.types import Scene, View

TARGET_BYTES = 256 << 20
"""Most bytes of float32 images and code maps that are kept for the losses. If all views need more, those of one iteration are kept."""


LanguageMap = Literal["masks", "codes", "valid"]


@dataclass(frozen=True)
class Target:
    """What one training view should look like; its tensors are shared between iterations.

    With ``levels=joint`` the l mask levels of a pixel stand beside each other in its row, so that losses and blending need not know of
    levels. Maps of language are there where `has_language` says so.
    """

    view: View
    image: Float[Tensor, "h w 3"]
    has_language: bool
    read: Callable[[LanguageMap], Tensor]
    """Makes a map of language when it is first asked for: one of codes can be large."""

    @property
    def masks(self) -> Int[Tensor, "h wl"]:
        """Row of `vlgs.types.Scene.mask_vectors` per pixel, -1 where there is no mask."""
        return self.read("masks")

    @property
    def codes(self) -> Float[Tensor, "h wl t"]:
        """What pixels should show of language (`vlgs.heads.Head.targets`), mostly codes."""
        return self.read("codes")

    @property
    def valid(self) -> Bool[Tensor, "h wl"]:
        """Where there is a mask."""
        return self.read("valid")


class TrainingViews:
    """The training views of a scene, in the pairs in which an iteration sees them.

    Args:
        scene: With at least one training view.
        codes: Target of every mask, [m, t]; m = 0 without language.
        sampler: Which views an iteration sees.
        counts: Where similarities that are known already are counted.

    Attributes:
        codes: Targets by mask, and the one of no mask.
        left_out: Masks that are as if they were not there, see `leave_out`; None: none.
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
        self.codes = torch.cat([codes, torch.zeros(1, codes.shape[1])])
        self.cache = PixelCache(self._room())
        self.left_out: Bool[Tensor, " m"] | None = None

    def at_half_size(self) -> "TrainingViews":
        """The same views, in the same pairs, with half their width and height."""
        views = TrainingViews(half_size(self.scene), self.codes[:-1], self.sampler, self.counts)
        views.left_out = self.left_out
        return views

    def leave_out(self, masks: Bool[Tensor, " m"]) -> None:
        """From now on, the pixels of these masks have none."""
        self.left_out = masks
        self.cache = PixelCache(self._room())

    def __getitem__(self, index: int) -> Target:
        """A training view by its place in the scene."""
        view, kept = self.scene.train[index], self.cache
        image = kept.get((index, "image"), lambda: view.read_image().to(torch.float32).div_(255.0))
        language = view.read_masks is not None and self.has_language
        return Target(view, image, language, partial(self._map, index))

    def codes_of(self, masks: Int[Tensor, "*b"]) -> Float[Tensor, "*b t"]:
        """Targets of masks, by their rows; -1 gives zeros."""
        return self.codes[masks.long()]

    def _map(self, index: int, name: LanguageMap) -> Tensor:
        read = self.scene.train[index].read_masks
        assert read is not None  # whoever asks has looked
        # With l mask levels, each pixel becomes l neighbours in its row.
        makers: Mapping[LanguageMap, Callable[[], Tensor]] = {
            "masks": lambda: self._kept(read()).flatten(1),
            "codes": lambda: self.codes_of(self._kept(read())).flatten(1, -2),
            "valid": lambda: (self._kept(read()) >= 0).flatten(1),
        }
        return self.cache.get((index, name), makers[name])

    def _kept(self, masks: Int[Tensor, "*b"]) -> Int[Tensor, "*b"]:
        if self.left_out is None:
            return masks
        # "No mask" is -1, which indexes the last entry.
        gone = torch.cat([self.left_out, torch.zeros(1, dtype=torch.bool)])
        return masks.masked_fill(gone[masks.long()], -1)

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
        code = 4 * self.codes.shape[1] + 1  # and whether it counts
        pixel = 3 * 4 + (code * self.scene.mask_levels if self.has_language else 0)
        views = [pixel * view.camera.width * view.camera.height for view in self.scene.train]
        return sum(views) if sum(views) <= TARGET_BYTES else 2 * max(views)


def masked_codes(
    feature: Float[Tensor, "h w c"], target: Target
) -> tuple[Float[Tensor, "p d"], Int[Tensor, " p"]]:
    """The rendered codes of the pixels that have a mask, and the rows of their masks; mask levels of a pixel count one by one."""
    rows = target.valid.flatten().nonzero()[:, 0]
    codes = _Rows.apply(feature.view(target.valid.numel(), -1), rows)
    return cast(Tensor, codes), target.masks.flatten()[rows].long()


class _Rows(torch.autograd.Function):
    """Rows of which none comes twice: PyTorch adds their gradients up, on one thread or atomically."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shape = values.shape
        return values.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        (rows,) = ctx.saved_tensors
        return grad_outputs[0].new_zeros(ctx.shape).index_copy_(0, rows, grad_outputs[0]), None


def covered(view: View) -> Bool[Tensor, "h w"] | None:
    """Pixels that the photograph of a view covers; None for all."""
    return None if view.read_valid is None else view.read_valid()
