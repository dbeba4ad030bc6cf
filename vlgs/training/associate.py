"""Masks of different views that show one object get one id: association over views through the geometry, from the masks alone."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.training.group_masks import group_masks
from vlgs.training.mask_weights import MaskWeights, mask_weights, masked_views
from vlgs.training.stages import Level, Progress
from vlgs.training.workshop import Workshop
from vlgs.types import Scene
from vlgs.values import require_range

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Associate:
    """Replaces the masks of the scene by objects that all views agree on; what comes after it learns these.

    Two masks are of one object where the same Gaussians are blended into both; `group_masks` says how. An object has the mean vector of its masks, by
    area. No tracker is asked, and no order of the views is needed. The embeddings of the masks take no part in it.

    Raises:
        ValueError: If an overlap is not in [0, 1], or there is none.
    """

    start: str
    """The earlier stage whose Gaussians tell what is in front."""
    overlaps: Sequence[float] = (0.5, 0.4, 0.3, 0.2, 0.1)
    """Least intersections over union of masks that become one, one after the other."""
    min_views: int = 2
    """Views that an object is seen in, at least; masks of others are left out."""

    def __post_init__(self) -> None:
        if not self.overlaps or not all(0 < least <= 1 for least in self.overlaps):
            raise ValueError(
                f"associate: overlaps must be above 0 and at most 1, one or more, got {list(self.overlaps)}"
            )
        require_range("associate", 1, 10**6, min_views=self.min_views)

    def require(self, scenes: Mapping[Level, Scene]) -> None:
        """Refuse scenes without masks, before anything is trained.

        Raises:
            ValueError: If none of them has any.
        """
        if not any(len(scene.mask_vectors) for scene in scenes.values()):
            raise ValueError(
                "associate: the scene must have masks to be associated over its views, got none (data.features=)"
            )

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `vlgs.training.stages.Stage`.

        Raises:
            ValueError: If no object is found in a scene that has masks.
        """
        scenes = {}
        for level, scene in progress.scenes.items():
            if len(scene.mask_vectors):
                model = progress.gaussians(self.start, level)
                sums = [mask_weights(model, scene, place) for place in range(scene.mask_levels)]
                objects = self.objects(scene, sums)
                log.info("associate: %d masks are %d objects", len(objects), objects.max() + 1)
                scene = of_objects(scene, objects)
            scenes[level] = scene
        return replace(progress, scenes=scenes)

    def objects(self, scene: Scene, sums: Sequence[MaskWeights]) -> Int[Tensor, " m"]:
        """The object of every mask, from 0; -1 where it is of none. Levels have objects of their own.

        Args:
            scene: Whose masks.
            sums: `mask_weights` of each mask level.

        Raises:
            ValueError: If there is no object.
        """
        found = torch.full((len(scene.mask_vectors),), -1)
        for place, of_level in enumerate(sums):
            views = view_of_mask(scene, place)
            groups = group_masks(of_level, views, self.overlaps)
            seen = _views_per_group(groups, views)
            kept = groups >= 0
            kept[groups >= 0] = seen[groups[groups >= 0]] >= self.min_views
            _, number = torch.unique(groups[kept], return_inverse=True)
            found[kept] = number + found.max() + 1
        if found.max() < 0:
            raise ValueError(
                f"associate: objects that {self.min_views} views show must be at least 1, got none of {len(found)} masks"
            )
        return found


def view_of_mask(scene: Scene, level: int = 0) -> Int[Tensor, " m"]:
    """Number of the training view of every mask of a level; -1 for those of others."""
    views = torch.full((len(scene.mask_vectors),), -1)
    for number, view in enumerate(masked_views(scene, level)):
        views[view.index[view.index >= 0].long()] = number
    return views


def _views_per_group(groups: Int[Tensor, " m"], views: Int[Tensor, " m"]) -> Int[Tensor, " g"]:
    pairs = torch.unique(torch.stack([groups, views])[:, groups >= 0], dim=1)
    return torch.bincount(pairs[0], minlength=int(groups.max()) + 1 if len(groups) else 0)


def of_objects(scene: Scene, objects: Int[Tensor, " m"]) -> Scene:
    """The scene whose masks are objects: rows are theirs, vectors the mean by area of the masks that make them.

    Args:
        scene: With masks of single views.
        objects: Of every mask, from 0, none left out; -1: the mask goes.
    """
    kept, count = objects >= 0, int(objects.max()) + 1
    areas = scene.mask_areas.double()[kept]
    vectors = torch.zeros(count, scene.mask_vectors.shape[1], dtype=torch.float64)
    vectors.index_add_(0, objects[kept], scene.mask_vectors.double()[kept] * areas[:, None])
    table = torch.cat([objects, torch.tensor([-1])]).to(torch.int32)  # "no mask" is -1
    views = [
        view
        if view.read_masks is None
        else replace(view, read_masks=partial(_read_objects, view.read_masks, table))
        for view in scene.train
    ]
    return replace(
        scene,
        train=tuple(views),
        mask_vectors=normalize(vectors, dim=1).to(scene.mask_vectors),
        mask_areas=torch.zeros(count)
        .double()
        .index_add_(0, objects[kept], areas)
        .to(scene.mask_areas),
    )


def _read_objects(
    read: Callable[[], Int[Tensor, "h w *levels"]], table: Int[Tensor, " m1"]
) -> Int[Tensor, "h w *levels"]:
    return table[read().long()]
