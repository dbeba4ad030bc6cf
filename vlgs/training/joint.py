"""Several mask levels learned by one model (``levels=joint``; conf/README.md)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate

import torch
from jaxtyping import Int
from torch import Tensor

from vlgs.types import Scene, View


def join_levels(scenes: Sequence[Scene]) -> Scene:
    """One scene whose views tell the masks of all levels apart, in the order of the scenes.

    Vectors and areas are stacked, so that one head serves all levels, as in LangSplat. All else is that of the last scene.

    Args:
        scenes: One scene read at several mask levels, with the same training views.
    """
    if len(scenes) == 1:
        return scenes[0]
    starts = [0, *accumulate(len(scene.mask_vectors) for scene in scenes)]
    train = []
    for views in zip(*(scene.train for scene in scenes), strict=True):
        assert len({view.name for view in views}) == 1
        readers = [view.read_masks for view in views]
        joined = _Joined(views[-1], readers, starts) if any(readers) else None
        train.append(replace(views[-1], read_masks=joined))
    return replace(
        scenes[-1],
        train=tuple(train),
        mask_vectors=torch.cat([scene.mask_vectors for scene in scenes]),
        mask_areas=torch.cat([scene.mask_areas for scene in scenes]),
        mask_levels=len(scenes),
        fingerprint=" ".join(scene.fingerprint for scene in scenes),
    )


class _Joined:
    """Reader of one view's masks at all levels; a level without masks has none anywhere.

    Args:
        view: Whose size counts.
        readers: Of each level.
        starts: First row of each level in the joined table of vectors.
    """

    def __init__(
        self,
        view: View,
        readers: Sequence[Callable[[], Int[Tensor, "h w"]] | None],
        starts: Sequence[int],
    ) -> None:
        self.size = (view.camera.height, view.camera.width)
        self.levels = list(zip(readers, starts, strict=False))  # the last start is the end

    def __call__(self) -> Int[Tensor, "h w levels"]:
        maps = [self._read(read, start) for read, start in self.levels]
        return torch.stack(maps, dim=-1)

    def _read(
        self, read: Callable[[], Int[Tensor, "h w"]] | None, start: int
    ) -> Int[Tensor, "h w"]:
        if read is None:
            return torch.full(self.size, -1, dtype=torch.int32)
        rows = read()
        return torch.where(rows >= 0, rows + start, -1)
