"""The mask of a training view that a word is learned from: one of the scene's own, or a picture from wherever the user has it."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.data.labels.pictures import find_pngs, marked
from vlgs.data.untrusted.pictures import picture
from vlgs.fields import Field
from vlgs.types import Scene, View

log = logging.getLogger(__name__)

Found = tuple[View, Bool[Tensor, "h w"]]
"""A training view, and what belongs to a word there."""


@dataclass(frozen=True)
class OwnMasks:
    """The scene's own masks: of those whose vectors are nearest to a word the one whose pixels the field sets apart most.

    The nearest alone would not do, since single masks may carry the vector of something else.
    """

    candidates: int
    """How many of the nearest are looked at."""

    def require(self, scene: Scene, words: Sequence[str]) -> None:
        """Nothing: without masks no language is trained either."""

    def find(
        self, field: Field, scene: Scene, name: str, word: Float[Tensor, " e"]
    ) -> Found | None:
        """The mask that is taken for a word; None without any.

        Args:
            field: The trained scene, of one mask level.
            scene: Its training views and masks.
            name: The word.
            word: Its vector, of unit length.
        """

        def contrast(found: Found) -> float:
            view, mask = found
            answer = field.similarity(view.camera, word[None])[0, 0]
            return float(answer[mask].mean() - answer[~mask].mean())

        return max(islice(_nearest(scene, word), self.candidates), key=contrast, default=None)


@dataclass(frozen=True)
class MaskFolder:
    """Pictures ``<folder>/<word>/<view>.png`` of a detector, or drawn by hand.

    A pixel that is neither black nor transparent belongs to the word. A picture is of the photograph as training sees it, undistorted, at any
    resolution. Of several training views that have one for a word the first counts.
    """

    folder: str

    def require(self, scene: Scene, words: Sequence[str]) -> None:
        """Read every picture that will be asked for, and name words that have none.

        Raises:
            ValueError: If no word has any, or a picture shows a word nowhere or everywhere.
        """
        without = [word for word in words if self._read(scene, word) is None]
        if len(without) == len(words):
            raise ValueError(
                f"query: masks {self.folder} must have <word>/<view>.png for a word that is asked and a training view, "
                f"such as {words[0]}/{scene.train[0].name}.png, got none"
            )
        if without:
            log.warning(
                "query: %s has no mask of a training view for %s", self.folder, ", ".join(without)
            )

    def find(
        self, field: Field, scene: Scene, name: str, word: Float[Tensor, " e"]
    ) -> Found | None:
        """The mask of a word; None without any. Arguments are those of `OwnMasks.find`."""
        return self._read(scene, name)

    def _read(self, scene: Scene, name: str) -> Found | None:
        files = self._files.get(name, {})
        view = next((view for view in scene.train if view.name in files), None)
        if view is None:
            return None
        mask = _read_mask(files[view.name], (view.camera.height, view.camera.width))
        return view, mask

    @cached_property
    def _files(self) -> dict[str, dict[str, Path]]:
        """Word -> view -> picture. Folders are listed, so that no word leads out of them."""
        folder = Path(self.folder)
        words = sorted(folder.iterdir()) if folder.is_dir() else []
        return {word.name: {path.stem: path for path in find_pngs(word)} for word in words}


def masks_from(folder: str | None, candidates: int) -> OwnMasks | MaskFolder:
    """The pictures of a folder; None: the scene's own masks."""
    return OwnMasks(candidates) if folder is None else MaskFolder(folder)


def _nearest(scene: Scene, word: Float[Tensor, " e"]) -> Iterator[Found]:
    """Training views and their masks, those whose vectors are nearest to a word first."""
    order = (normalize(scene.mask_vectors.float(), dim=-1) @ word).argsort(descending=True)
    for row in order.tolist():
        for view in scene.train:
            if view.read_masks is None:
                continue
            mask = view.read_masks() == row
            mask = mask if mask.dim() == 2 else mask.any(dim=-1)
            if mask.any() and not mask.all():
                yield view, mask


def _read_mask(path: Path, size: tuple[int, int]) -> Bool[Tensor, "h w"]:
    """A picture at the size of a view: each pixel has what the middle of it shows."""
    with picture(path, decode=True) as image:
        inside = marked(image)
    rows, columns = (
        ((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(size, inside.shape, strict=True)
    )
    mask = torch.from_numpy(inside[rows][:, columns])
    if not mask.any() or mask.all():
        got = "all of them" if mask.any() else "none"
        raise ValueError(
            f"query: {path} must have some pixels that are neither black nor transparent, got {got}"
        )
    return mask
