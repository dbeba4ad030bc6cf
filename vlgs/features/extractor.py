"""What an extractor is, and the one that joins a segmenter and an encoder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from vlgs.features.masks import Mask, paint
from vlgs.types import Vocabulary

LEVELS = 4
"""0 default, 1 subpart, 2 part, 3 whole: the order of LangSplat's maps."""


_WITHOUT_WEIGHTS = "(features/segmenter=superpixels and features/encoder=maps need no weights)"


@dataclass(frozen=True)
class MaskFeatures:
    """Masks of one photograph at four levels, and a vector for each."""

    ids: Int32[np.ndarray, "4 h w"]
    """Row of `vectors` that a pixel has at each level, -1 for none; rows run on from level to level."""
    vectors: Float32[np.ndarray, "m e"]
    """Unit length."""


@runtime_checkable
class Extractor(Protocol):
    """A photograph to masks and vectors: the whole contract of `features.extractor`."""

    def identity(self) -> Mapping[str, str]:
        """Name -> hash of all that was read besides the configuration (weights); part of the settings of a folder.

        Raises:
            FileNotFoundError: If weights are not on this machine; it says which and where they go.
        """
        ...

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], stem: str) -> MaskFeatures:
        """Masks and vectors of one photograph.

        Raises:
            ValueError: If the photograph cannot be described.
        """
        ...


@runtime_checkable
class KnowsWords(Protocol):
    """An extractor whose vectors lie in the space of words that it was given: what can be asked of its maps."""

    vocabulary: Vocabulary


@runtime_checkable
class Segmenter(Protocol):
    """A photograph to masks."""

    def identity(self) -> Mapping[str, str]:
        """As `Extractor.identity`."""
        ...

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> Sequence[Sequence[Mask]]:
        """Masks of the four levels, each in the order in which they are painted."""
        ...


@runtime_checkable
class Encoder(Protocol):
    """Masks of a photograph to vectors."""

    def identity(self) -> Mapping[str, str]:
        """As `Extractor.identity`."""
        ...

    def __call__(
        self, image: UInt8[np.ndarray, "h w 3"], masks: Sequence[Mask], stem: str
    ) -> Float32[np.ndarray, "m e"]:
        """A vector for each mask, not zero; its length does not matter."""
        ...


class MaskExtractor:
    """Masks of a segmenter, described by an encoder.

    A mask that later ones of its level cover whole is left out, and one that several levels share is encoded once:
    neither moves a pixel's vector.

    Args:
        segmenter: What finds the masks.
        encoder: What describes them.
        levels: Levels that are wanted; the others hold no mask. Training reads one of them, `data.level`.

    Raises:
        ValueError: If a level is not one of 0 to 3.
    """

    def __init__(
        self, segmenter: Segmenter, encoder: Encoder, levels: Sequence[int] = range(LEVELS)
    ):
        if not levels or set(levels) - set(range(LEVELS)):
            raise ValueError(f"features: levels must be some of 0, 1, 2 and 3, got {list(levels)}")
        self.segmenter = segmenter
        self.encoder = encoder
        self.levels = frozenset(levels)

    def identity(self) -> Mapping[str, str]:
        """Of both parts.

        Raises:
            FileNotFoundError: If weights are missing, with those of both parts in one message.
        """
        found, missing = {}, []
        for part in (self.segmenter, self.encoder):
            try:
                found |= part.identity()
            except FileNotFoundError as error:
                missing.append(str(error))
        if missing:
            raise FileNotFoundError("\n".join([*missing, _WITHOUT_WEIGHTS]))
        return found

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], stem: str) -> MaskFeatures:
        """See `Extractor`.

        Raises:
            ValueError: If the encoder's vectors are not finite, or zero.
        """
        size = image.shape[:2]
        ids = np.full((LEVELS, *size), -1, np.int32)
        shown: list[Mask] = []
        for level, masks in enumerate(self.segmenter(image)):
            if level not in self.levels:
                continue
            painted = paint(masks, size)
            used = np.flatnonzero(np.bincount(painted.ravel() + 1, minlength=len(masks) + 1)[1:])
            rows = np.full(len(masks) + 1, -1, np.int32)
            rows[used + 1] = len(shown) + np.arange(len(used), dtype=np.int32)
            ids[level] = rows[painted + 1]
            shown += [masks[i] for i in used.tolist()]
        return MaskFeatures(ids, self._encode(image, shown, stem))

    def _encode(self, image: np.ndarray, masks: Sequence[Mask], stem: str) -> np.ndarray:
        """Unit vectors, equal masks encoded once."""
        keys = [mask.key for mask in masks]
        distinct = {key: mask for key, mask in zip(keys, masks, strict=True)}
        position = {key: i for i, key in enumerate(distinct)}
        vectors = encode(self.encoder, image, list(distinct.values()), stem)
        return vectors[[position[key] for key in keys]]


def encode(
    encoder: Encoder, image: UInt8[np.ndarray, "h w 3"], masks: Sequence[Mask], stem: str
) -> Float32[np.ndarray, "m e"]:
    """What an encoder says of masks, at unit length.

    Raises:
        ValueError: If a vector is not finite, or zero.
    """
    vectors = encoder(image, masks, stem)
    norms = np.linalg.norm(vectors, axis=1, keepdims=True)
    wrong = np.flatnonzero(~(np.isfinite(norms[:, 0]) & (norms[:, 0] > 0)))
    if len(wrong):
        raise ValueError(
            f"features: vectors of {stem} must be finite and not zero, got length {norms[wrong[0], 0]} for the mask "
            f"in box {masks[int(wrong[0])].box} and {len(wrong) - 1} others"
        )
    return (vectors / norms).astype(np.float32)
