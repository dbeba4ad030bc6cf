"""Rules that lift language onto finished Gaussians: from the pixels that a Gaussian is blended into to one code, without training.

Throughout, w_ip is the blending weight of Gaussian i at pixel p of a training view, H_p the target of the mask there, and sums run over the pixels
that have a mask. A Gaussian that none of them shows keeps the code zero, which answers no word.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.fields.splat import SplatModel
from vlgs.ops.pixel_weights import PixelWeights
from vlgs.training.lightning import VLGSModule
from vlgs.training.mask_weights import MaskWeights, Share, by_rank, mask_weights
from vlgs.types import Scene
from vlgs.values import require_range

GAUSSIANS = 4096
"""Whose medians are computed at once: bounds the memory."""
NEAREST = 1e-3
"""Least distance of a median to a point, whose weight is divided by it."""


@runtime_checkable
class LiftRule(Protocol):
    """The interface of a rule: a frozen dataclass of its settings."""

    @property
    def share(self) -> Share | None:
        """What counts of the weights at a pixel; None: the weights themselves."""
        ...

    def combine(self, sums: MaskWeights, vectors: Float[Tensor, "m t"]) -> Float[Tensor, "n t"]:
        """Codes of all Gaussians.

        Args:
            sums: Per Gaussian and mask what counts, summed over pixels.
            vectors: Targets of the masks.
        """
        ...


@runtime_checkable
class Refining(Protocol):
    """A rule that goes on from the codes that it made of sums, with renders of the views."""

    def refine(
        self,
        model: SplatModel,
        scene: Scene,
        vectors: Float[Tensor, "m t"],
        starts: Sequence[Float[Tensor, "n t"]],
    ) -> Sequence[Float[Tensor, "n t"]]:
        """Codes of all Gaussians, of every mask level.

        Args:
            model: Whose Gaussians.
            scene: Whose masks.
            vectors: Targets of the masks.
            starts: From `LiftRule.combine`, level by level.
        """
        ...


@runtime_checkable
class Sampling(Protocol):
    """A rule that does not look at all pixels of a large view."""

    @property
    def pixels(self) -> int:
        """Most of a view (`vlgs.training.mask_weights.masked_views`)."""
        ...


@dataclass(frozen=True)
class Mean:
    """``sum w H / sum w`` (LUDVIG, Marrie et al., ICCV 2025; Occam's LGS, Cheng et al., 2024, where the centre's pixel stands for all)."""

    share: ClassVar[Share | None] = None

    def combine(self, sums: MaskWeights, vectors: Float[Tensor, "m t"]) -> Float[Tensor, "n t"]:
        """See `LiftRule`."""
        total = sums.totals()
        return sums.sums(vectors) / total.clamp_min(torch.finfo(total.dtype).tiny)


@dataclass(frozen=True)
class Consensus:
    """``sum w H / (sum w + absent sum' w)``, the second sum over pixels without a mask: what all that see a Gaussian say of it.

    The length of a code is how far its views agree, and that they say something at all: a mask that was missed in some views shortens the code of its
    thing and turns it nowhere, and what hardly any mask shows, as a sky, has next to none. `vlgs.heads.principal.Principal` answers by it.

    Raises:
        ValueError: If `absent` is not in [0, 1].
    """

    share: ClassVar[Share | None] = None
    absent: float = 1.0
    """What a pixel without a mask counts beside one with; 0: nothing, as in `Mean`."""

    def __post_init__(self) -> None:
        require_range("consensus", 0, 1, absent=self.absent)

    def combine(self, sums: MaskWeights, vectors: Float[Tensor, "m t"]) -> Float[Tensor, "n t"]:
        """See `LiftRule`."""
        total = sums.totals() + self.absent * sums.unmasked[:, None]
        return sums.sums(vectors) / total.clamp_min(torch.finfo(total.dtype).tiny)


@dataclass(frozen=True)
class Squared:
    """``sum w^2 H / sum w^2`` (Splat Feature Solver, Xiong et al., 2025, as released): pixels where a Gaussian stands out count more."""

    def share(self, part: PixelWeights) -> Float[Tensor, " z"]:
        """The square."""
        return part.weight.square()

    def combine(self, sums: MaskWeights, vectors: Float[Tensor, "m t"]) -> Float[Tensor, "n t"]:
        """See `LiftRule`."""
        return Mean().combine(sums, vectors)


@dataclass(frozen=True)
class Direction:
    """``S / |S|`` with ``S = sum w H`` (NormLift, 2026): the code that has the largest mean cosine with what its pixels show."""

    share: ClassVar[Share | None] = None

    def combine(self, sums: MaskWeights, vectors: Float[Tensor, "m t"]) -> Float[Tensor, "n t"]:
        """See `LiftRule`."""
        return normalize(sums.sums(vectors), dim=-1)


@dataclass(frozen=True)
class TopK:
    """``S / |S|`` where at each pixel the k Gaussians of largest weight count alone (Dr.Splat, Jun-Seong et al., CVPR 2025).

    Raises:
        ValueError: If k is not positive.
    """

    k: int = 40

    def __post_init__(self) -> None:
        require_range("top_k", 1, 2**31, k=self.k)

    def share(self, part: PixelWeights) -> Float[Tensor, " z"]:
        """The weights of the k largest, else 0."""
        order, rank = by_rank(part)
        return torch.zeros_like(part.weight).index_put_(
            (order,), part.weight[order] * (rank < self.k)
        )

    def combine(self, sums: MaskWeights, vectors: Float[Tensor, "m t"]) -> Float[Tensor, "n t"]:
        """See `LiftRule`."""
        return Direction().combine(sums, vectors)


@dataclass(frozen=True)
class Robust:
    """The geometric median of what a Gaussian's pixels show, weighted by w, of the pixels where it is seen (VALA, Wang et al., 3DV 2026).

    At a pixel those Gaussians are seen that hold `mass` of its weight, the largest first, and that have a weight of `floor` or more; the largest of
    all is always seen. The median minimises ``sum w |f - H|`` and comes at unit length.

    This is a reading: the paper gates the contributions along each ray, which is done here; the released code gates one contribution per Gaussian and
    view, takes H at the pixel of its centre, and moves the median by one step per view where this one is iterated over all of them.

    Raises:
        ValueError: If a share is not in [0, 1], or there is no step.
    """

    mass: float = 0.75
    floor: float = 0.13
    steps: int = 20
    """Of Weiszfeld's algorithm, from the mean."""

    def __post_init__(self) -> None:
        require_range("robust", 0, 1, mass=self.mass, floor=self.floor)
        require_range("robust", 1, 10_000, steps=self.steps)

    def share(self, part: PixelWeights) -> Float[Tensor, " z"]:
        """The weights of what is seen, else 0."""
        order, rank = by_rank(part)
        weight = part.weight[order]
        before = weight.cumsum(0) - weight
        first = torch.searchsorted(part.pixel, part.pixel)
        last = torch.searchsorted(part.pixel, part.pixel, right=True) - 1
        total = (before + weight)[last] - before[first]
        seen = (before - before[first] < self.mass * total) & (weight >= self.floor)
        return torch.zeros_like(weight).index_put_((order,), weight * (seen | (rank == 0)))

    def combine(self, sums: MaskWeights, vectors: Float[Tensor, "m t"]) -> Float[Tensor, "n t"]:
        """See `LiftRule`."""
        median = Mean().combine(sums, vectors)
        bounds = torch.searchsorted(sums.gaussian, torch.arange(0, sums.gaussians, GAUSSIANS))
        for _ in range(self.steps):
            near = [
                _distances(rows, vectors, *entries)
                for rows, *entries in zip(
                    median.split(GAUSSIANS),
                    sums.gaussian.tensor_split(bounds[1:]),
                    sums.mask.tensor_split(bounds[1:]),
                    strict=True,
                )
            ]
            pull = sums.weight / torch.cat(near)
            total = sums.weight.new_zeros(sums.gaussians).index_add_(0, sums.gaussian, pull)
            median = sums.sums(vectors, pull) / total[:, None].clamp_min(
                torch.finfo(total.dtype).tiny
            )
        return normalize(median, dim=-1)


def _distances(
    codes: Float[Tensor, "n t"], vectors: Float[Tensor, "m t"], gaussian: Tensor, mask: Tensor
) -> Float[Tensor, " z"]:
    """Of codes to the vectors of their masks; `gaussian` counts in the scene, of which `codes` are `GAUSSIANS` rows."""
    squares = codes.square().sum(dim=1)[:, None] + vectors.square().sum(dim=1)
    distance = (squares - 2 * codes @ vectors.T)[gaussian % GAUSSIANS, mask]
    return distance.clamp_min(0).sqrt().clamp_min(NEAREST)


@torch.no_grad()
def lift_by(rule: LiftRule, module: VLGSModule) -> None:
    """Set the codes of a module's Gaussians to what a rule makes of the masks of its scene, in place."""
    model, scene = module.model, module.views.scene
    vectors = model.head.targets(scene.mask_vectors.to(model.splats["features"]))
    pixels = rule.pixels if isinstance(rule, Sampling) else None
    codes: Sequence[Tensor] = [
        rule.combine(mask_weights(model, scene, level, rule.share, pixels), vectors)
        for level in range(model.levels)
    ]
    if isinstance(rule, Refining):
        codes = rule.refine(model, scene, vectors, codes)
    model.splats["features"].copy_(torch.cat(list(codes), dim=1))
