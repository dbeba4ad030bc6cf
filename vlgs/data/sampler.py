"""Chooses the views of an iteration as a pure function of (seed, step), so that a resumed run sees the same views."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch

from vlgs.geometry import camera_center
from vlgs.types import Camera


@dataclass(frozen=True)
class PairSampler:
    """Two views per iteration, drawn from two independently shuffled stacks (conf/README.md, D.13).

    Every view is visited once per epoch of each stack. Where both stacks show the same view, or two views whose images
    differ in size and so cannot be blended, the second one is drawn again among the views that fit.

    Args:
        sizes: (width, height) of every training view.
        seed: Seed of the run.
        near: Per view those that the second one is drawn from, in place of the second stack (`nearest_views`).
    """

    sizes: tuple[tuple[int, int], ...]
    seed: int
    near: tuple[tuple[int, ...], ...] | None = None

    def __post_init__(self) -> None:
        if not self.sizes:
            raise ValueError("PairSampler: training views must be at least 1, got 0")

    def pair(self, step: int) -> tuple[int, int]:
        """Indices of the two views of an iteration; equal only where no other view has the first one's size."""
        epoch, position = divmod(step, len(self.sizes))
        first = int(self._stack(0, epoch)[position])
        if self.near is not None:
            near = self.near[first] or (first,)
            return first, near[int(self.rng(2, step).integers(len(near)))]
        second = int(self._stack(1, epoch)[position])
        if second != first and self.sizes[second] == self.sizes[first]:
            return first, second
        fitting = [i for i in self._same_size[self.sizes[first]] if i != first]
        if not fitting:
            return first, first
        return first, fitting[int(self.rng(2, step).integers(len(fitting)))]

    def rng(self, purpose: int, step: int) -> np.random.Generator:
        """A generator of its own for every purpose and step."""
        return np.random.default_rng([self.seed, purpose, step])

    def ratio_rng(self, step: int) -> np.random.Generator:
        """The generator that draws the blend ratio of an iteration."""
        return self.rng(3, step)

    def dropout_rng(self, step: int) -> np.random.Generator:
        """The generator that draws the Gaussians which an iteration leaves out."""
        return self.rng(4, step)

    @cached_property
    def _same_size(self) -> dict[tuple[int, int], list[int]]:
        groups: dict[tuple[int, int], list[int]] = {}
        for index, size in enumerate(self.sizes):
            groups.setdefault(size, []).append(index)
        return groups

    def _stack(self, which: int, epoch: int) -> np.ndarray:
        return _permutation(self.seed, which, epoch, len(self.sizes))


@lru_cache(maxsize=8)
def _permutation(seed: int, which: int, epoch: int, count: int) -> np.ndarray:
    return np.random.default_rng([seed, which, epoch]).permutation(count)


def nearest_views(cameras: Sequence[Camera], count: int | None) -> tuple[tuple[int, ...], ...]:
    """Per camera the others of its image size whose centres are nearest, nearest first; all of them without a count."""
    centers = camera_center(torch.stack([camera.viewmat for camera in cameras]).double())
    sizes = [(camera.width, camera.height) for camera in cameras]
    near = []
    for index, size in enumerate(sizes):
        order = (centers - centers[index]).norm(dim=1).argsort(stable=True).tolist()
        near.append(tuple(i for i in order if i != index and sizes[i] == size)[:count])
    return tuple(near)
