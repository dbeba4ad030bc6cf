"""How far other views support what a mask says, and training without the masks that none does.

An encoder takes a table for a wall in one photograph of twelve. No loss over pixels can tell: with an indicator, training explains that photograph by
Gaussians of its own before its camera, and a view from between the cameras sees a wall on the table. All photographs together can
tell, as soon as Gaussians are roughly where things are: of the Gaussians under a right mask, most others say the same.

Things smaller than a Gaussian share theirs with what surrounds them, which outvotes them in every view. It does so in the view of the mask itself,
too, hence the ratio of the two.
"""

import logging
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import one_hot

from vlgs.fields.splat import SplatModel
from vlgs.heads.clusters import clusters
from vlgs.objectives import Language
from vlgs.training.after_step import AfterStep, TrainedModule
from vlgs.training.lightning import VLGSModule
from vlgs.training.mask_weights import view_sums
from vlgs.types import Scene

log = logging.getLogger(__name__)

START = 0.2
"""Share of the iterations after which masks are judged. Of the first Gaussians, tables and walls can be judged as well, but not what is a few pixels wide."""
MOST = 1 / 3
"""Of the masks. If more have no support, views see different things, or masks are nothing to go by, and all stay."""
CLUSTERS = 32
"""Things that masks may be taken for."""
SAMPLE = 1 << 12
"""Masks, evenly chosen, by which clusters are found."""
ALIKE = 0.5
"""Least cosine of two clusters that say the same, from the mean of all masks: embeddings of one encoder share a large common direction."""
SEEN, KNOWN = 0.2, 0.3
"""Others see a Gaussian if their weight in it is this share of the own view's, and can judge a mask if it has this share of its weight in such ones."""
PIXELS = 1 << 15
"""Most that are looked at in a view (`vlgs.training.mask_weights.masked_views`)."""


@torch.no_grad()
def mask_support(model: SplatModel, scene: Scene) -> Float[Tensor, " m"]:
    """Support of every mask by the masks of other views, of the same level, over what it has in its own.

    Both are means over its Gaussians, by weight, of the share of masks that say the same as it does: over masks of other views and
    over those of its own. The ratio is about 1 where all agree and 0 where nobody does; 1 where others cannot judge.

    Args:
        model: Whose Gaussians.
        scene: Whose masks.
    """
    support = torch.ones(len(scene.mask_vectors))
    if len(support) == 0:
        return support
    cluster, alike = _meanings(scene.mask_vectors)
    for level in range(scene.mask_levels):
        views = [
            _View(cluster, numbers, sums)
            for numbers, sums in view_sums(model, scene, level, pixels=PIXELS)
        ]
        said = torch.zeros(model.count, CLUSTERS)
        for view in views:
            said[view.gaussians] += view.said
        for view in views:
            support[view.masks] = view.support(said, alike)
    return support


class _View:
    """The masks of a view, and its Gaussians that have weight in one.

    Args:
        cluster: Of every mask of the scene.
        numbers: From `view_sums`.
        sums: Likewise.
    """

    def __init__(
        self, cluster: Int[Tensor, " m"], numbers: Int[Tensor, " k"], sums: Float[Tensor, "n k"]
    ) -> None:
        inside = numbers >= 0
        self.masks = numbers[inside].long()
        self.meanings = cluster[self.masks]
        sums = sums[:, inside]
        self.gaussians = (sums > 0).any(dim=1).nonzero()[:, 0]
        self.weight = sums[self.gaussians]

    @property
    def said(self) -> Float[Tensor, "g clusters"]:
        """Weight of each cluster in its Gaussians."""
        # Made twice rather than kept: of hundreds of large views it would be most of a gigabyte.
        return self.weight @ one_hot(self.meanings, CLUSTERS).to(self.weight)

    def support(
        self, said: Float[Tensor, "n clusters"], alike: Bool[Tensor, "clusters clusters"]
    ) -> Float[Tensor, " k"]:
        """See `mask_support`; `said` by all views."""
        own, same = self.said, alike[self.meanings].to(said)
        others = (said[self.gaussians] - own).clamp_min(0)
        in_own, in_others = own.sum(dim=1, keepdim=True), others.sum(dim=1, keepdim=True)
        judged = self.weight * (in_others > SEEN * in_own)
        least = torch.finfo(said.dtype).tiny
        by_others = (judged * (others @ same.T) / in_others.clamp_min(least)).sum(dim=0)
        by_own = (judged * (own @ same.T) / in_own.clamp_min(least)).sum(dim=0)
        known = judged.sum(dim=0) > KNOWN * self.weight.sum(dim=0)
        return torch.where(known & (by_own > 0), by_others / by_own.clamp_min(least), 1.0)


def _meanings(
    vectors: Float[Tensor, "m e"],
) -> tuple[Int[Tensor, " m"], Bool[Tensor, "clusters clusters"]]:
    """The cluster of every mask, and which clusters say the same."""
    mean = vectors.float().mean(dim=0)
    some = vectors[:: -(-len(vectors) // SAMPLE)].float() - mean
    centers = clusters(some, CLUSTERS)
    nearest = (vectors.float() @ centers.T - mean @ centers.T).argmax(dim=1)
    return nearest, centers @ centers.T > ALIKE


class LeaveOut(AfterStep):
    """After a fifth of the iterations, leave masks out that other views do not support (`vlgs.objectives.Language`)."""

    def after_step(self, module: TrainedModule) -> None:
        """Do so when it is time."""
        assert isinstance(module, VLGSModule)
        least = _least(list(module.step.setup.objectives.values()))
        due = module.next_step == max(1, round(START * module.settings.iterations))
        if not due or least == 0 or not module.views.has_language:
            return
        scene = module.views.scene
        gone = mask_support(module.model, scene) < least
        count = int(gone.sum())
        if count > MOST * len(gone):
            log.info("%d of %d masks have no support by other views: all stay", count, len(gone))
        elif count:
            log.info(
                "%d of %d masks are left out: other views do not support them", count, len(gone)
            )
            module.step.leave_out(gone)


def _least(objectives: Sequence[object]) -> float:
    return max((one.support for one in objectives if isinstance(one, Language)), default=0.0)
