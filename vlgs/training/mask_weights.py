"""How much of every Gaussian the masks of the training views show: blending weights, summed over the pixels of each mask.

A view has a few dozen masks and thousands of pixels, so that language is lifted and masks are associated through these sums: no map of
embeddings is ever made.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import ceil, sqrt

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import embedding_bag

from vlgs.fields.splat import SplatModel
from vlgs.geometry import subsample_camera
from vlgs.objectives.targets import covered
from vlgs.ops.pixel_weights import PixelWeights, pixel_weights
from vlgs.ops.project import project
from vlgs.training.lift import sums_back
from vlgs.types import Camera, Scene

UNSEEN = -2
"""In place of a mask's row, where a photograph shows nothing."""
CHANNELS = 64
"""Masks whose sums are formed in one pass over the tiles."""

Share = Callable[[PixelWeights], Float[Tensor, " z"]]
"""From the weights of some pixels to what is summed of each."""


@dataclass(frozen=True)
class MaskedView:
    """A training view that has masks, or every `step`-th pixel of every `step`-th row of it."""

    camera: Camera
    index: Int[Tensor, "h w"] | Int[Tensor, "h w l"]
    """Row of `Scene.mask_vectors` per pixel, -1 where no mask lies; l mask levels where several are asked for."""
    covered: Bool[Tensor, "h w"] | None
    """Pixels that the photograph covers; None for all."""
    step: int


@dataclass(frozen=True)
class MaskWeights:
    """Sums of every pair of a Gaussian and a mask that have one, by Gaussian and then by mask."""

    gaussian: Int[Tensor, " z"]
    """int32, as `mask`: large scenes have hundreds of millions of pairs."""
    mask: Int[Tensor, " z"]
    """Row of `Scene.mask_vectors`."""
    weight: Float[Tensor, " z"]
    """Above 0."""
    unmasked: Float[Tensor, " n"]
    """Of every Gaussian over the pixels that no mask of its view has; pixels that a photograph does not cover are none of these."""

    @property
    def gaussians(self) -> int:
        """How many there are."""
        return len(self.unmasked)

    def sums(
        self, vectors: Float[Tensor, "m t"], weight: Float[Tensor, " z"] | None = None
    ) -> Float[Tensor, "n t"]:
        """Per Gaussian the weighted sum of the vectors of its masks; 0 where it has none.

        Args:
            vectors: One per mask.
            weight: In place of `weight`.
        """
        used = self.weight if weight is None else weight
        rows = torch.arange(self.gaussians, dtype=self.gaussian.dtype)
        starts = torch.searchsorted(self.gaussian, rows, out_int32=self.mask.dtype == torch.int32)
        return embedding_bag(
            self.mask, vectors, starts, mode="sum", per_sample_weights=used.to(vectors)
        )

    def totals(self) -> Float[Tensor, "n 1"]:
        """Per Gaussian the sum over its masks."""
        total = self.weight.new_zeros(self.gaussians)
        return total.index_add_(0, self.gaussian, self.weight)[:, None]


@torch.no_grad()
def mask_weights(
    model: SplatModel,
    scene: Scene,
    level: int = 0,
    share: Share | None = None,
    pixels: int | None = None,
) -> MaskWeights:
    """The sums over all training views, with the weights that blend language.

    Args:
        model: Whose Gaussians.
        scene: Whose masks.
        level: Place of the mask level, where `Scene.mask_levels` are several.
        share: What is summed of each pixel's weights; None: the weight itself, by the rasterizer's own backward pass.
        pixels: Most of a view, see `masked_views`.
    """
    masks = max(1, len(scene.mask_vectors))
    found: list[Tensor] = []
    values: list[Tensor] = []
    weight = _blended(model, level)
    unmasked = torch.zeros_like(weight)
    for numbers, sums in view_sums(model, scene, level, share, pixels):
        unmasked += sums[:, (numbers < 0) & (numbers != UNSEEN)].sum(1)
        sums[:, numbers < 0] = 0
        pairs = sums.nonzero()
        found.append(pairs[:, 0] * masks + numbers[pairs[:, 1]])
        values.append(sums[pairs[:, 0], pairs[:, 1]])
    return MaskWeights(*_sorted(found, values, masks, weight), unmasked)


@torch.no_grad()
def view_sums(
    model: SplatModel,
    scene: Scene,
    level: int = 0,
    share: Share | None = None,
    pixels: int | None = None,
) -> Iterator[tuple[Int[Tensor, " k"], Float[Tensor, "n k"]]]:
    """Of every training view the rows of its masks, with -1 for pixels without one and `UNSEEN`, and each Gaussian's sum over the pixels of each.

    Args: see `mask_weights`.
    """
    weight = _blended(model, level)
    for view in masked_views(scene, level, pixels):
        index = view.index
        if view.covered is not None:
            index = torch.where(view.covered | (index >= 0), index, UNSEEN)
        numbers, local = torch.unique(index, return_inverse=True)
        if share is None:
            yield numbers, _by_backward(model, view, weight, local, len(numbers))
        else:
            yield numbers, _one_by_one(model, view, weight, local, len(numbers), share)


def _blended(model: SplatModel, level: int) -> Float[Tensor, " n"]:
    """The weights that blend language of one level."""
    weight = model.fuse().language_weight
    return weight if weight.dim() == 1 else weight[:, level].contiguous()


def _sorted(
    found: list[Tensor], values: list[Tensor], masks: int, like: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussian, mask and weight of each pair, `found` as one number, in order. Empties the lists: these are the most memory that lifting takes."""
    if not found:
        none = torch.zeros(0, dtype=torch.int32)
        return none, none, like.new_zeros(0)
    weight = torch.cat(values)
    values.clear()
    pairs = torch.cat(found)
    found.clear()
    pairs, order = pairs.sort(stable=True)
    weight = weight[order]
    del order
    gaussian = pairs.div(masks, rounding_mode="floor").int()
    return gaussian, pairs.remainder_(masks).int(), weight


def masked_views(
    scene: Scene, level: int | Sequence[int] = 0, pixels: int | None = None
) -> Iterator[MaskedView]:
    """The training views that have masks, with those of one level or of some.

    Args:
        scene: Whose views.
        level: Place of the mask level, or places.
        pixels: Most of a view; a larger one is given by every n-th pixel of every n-th row, for the smallest n. None or 0: all.
    """
    for view in scene.train:
        if view.read_masks is not None:
            index = view.read_masks()
            if index.dim() == 3:
                index = index[..., level if isinstance(level, int) else list(level)]
            elif not isinstance(level, int):
                index = index[..., None]
            height, width = index.shape[:2]
            step = max(1, ceil(sqrt(height * width / pixels))) if pixels else 1
            seen, camera = covered(view), view.camera
            if step > 1:
                index, camera = index[::step, ::step], subsample_camera(camera, step)
                seen = None if seen is None else seen[::step, ::step]
            yield MaskedView(camera, index, seen, step)


def _by_backward(
    model: SplatModel,
    view: MaskedView,
    weight: Float[Tensor, " n"],
    local: Int[Tensor, "h w"],
    count: int,
) -> Float[Tensor, "n masks"]:
    """The sums are the gradient of the image by what is blended, upstream of it one channel per mask."""
    parts: list[Tensor] = []
    for first in range(0, count, CHANNELS):
        numbers = torch.arange(first, min(first + CHANNELS, count))
        inside = (local[..., None] == numbers).to(weight)
        values = weight.new_zeros(len(weight), len(numbers), requires_grad=True)
        with torch.enable_grad():
            image = model.render_values(view.camera, values, weight, view.step)
        parts.append(sums_back(image, values, inside))
    return torch.cat(parts, dim=1)


def _one_by_one(
    model: SplatModel,
    view: MaskedView,
    weight: Float[Tensor, " n"],
    local: Int[Tensor, "h w"],
    count: int,
    share: Share,
) -> Float[Tensor, "n masks"]:
    gaussians, flat = model.gaussians(), local.flatten()
    quats, scales = gaussians.quats, gaussians.scales
    if (own := gaussians.language_shape) is not None:
        quats, scales = own.quats, own.scales
    raster = model.raster_of(view.step)
    splats = project(gaussians.means, quats, scales, view.camera, raster)
    sums = torch.zeros(len(weight) * count, dtype=torch.float64)
    for part in pixel_weights(splats, weight, view.camera, raster):
        sums.index_add_(0, part.gaussian * count + flat[part.pixel], share(part))
    return sums.view(-1, count).to(weight)


def by_rank(part: PixelWeights) -> tuple[Int[Tensor, " z"], Int[Tensor, " z"]]:
    """Entries in the order of pixels and, in each, of falling weights; and their ranks, from 0. Of equal weights the front one comes first."""
    order = (part.pixel - part.weight).argsort(stable=True)  # weights are below 1
    return order, torch.arange(len(order)) - torch.searchsorted(part.pixel, part.pixel)
