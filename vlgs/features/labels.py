"""Masks of a scene's dense labels, each with its word's vector, spoilt as SAM and CLIP spoil them: no weights are needed.

For experiments on a labelled scene where a segmenter and an encoder are not at hand. Shapes and words are the labels', errors are simulated with
the model of the procedural scenes (`vlgs.data.synthetic.masks`): what is trained on such maps says nothing about SAM or CLIP themselves.
"""

import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from vlgs.data.diagnostics import SceneError
from vlgs.data.labels import DenseFolder, open_labels
from vlgs.data.language import read_vocabulary
from vlgs.data.synthetic.masks import LabelNoise, Region, view_masks
from vlgs.features.extractor import MaskFeatures
from vlgs.formats.start import file_digest, folder_digest
from vlgs.types import IGNORE_ID

_MODALITY = 0.8
"""How far image vectors lie beside text, as `vlgs.data.synthetic.language` has it."""
_SPACE = 151  # the seed of that direction: a constant, as the weights of an encoder are
_PARALLEL = 1e-6
"""Singular values below it are rounding: the words mean the same."""


class LabelMasks:
    """What a segmenter and an encoder that erred as told would have said of a labelled scene.

    Level 3 (whole) has a mask per class, 2 (part) one per connected piece of it, 1 (subpart) the quarters of each piece, cut at its median row and
    column; 0 (default) is whole classes over which about half of the finer masks are laid. Draws are functions of seed and photograph's name, so
    that a photograph's maps do not depend on the others.

    Args:
        labels: Folder of ``classes.json`` and ``<stem>.png``.
        words: File of text vectors, as `data.vocabulary`: one for each class, spelled as there.
        noise: Rates of errors; what is None is that of hard procedural scenes.
        seed: Of the errors.

    Raises:
        FileNotFoundError: If labels or words are not there.
        SceneError: If one of them is at fault.
        ValueError: If labels are not dense, words lack one of their classes, or `seed` is negative.
    """

    def __init__(
        self,
        labels: str,
        words: str,
        noise: LabelNoise = LabelNoise(),  # noqa: B008 (frozen)
        seed: int = 0,
    ):
        if seed < 0:
            raise ValueError(f"features: seed must not be negative, got {seed}")
        if not Path(labels).is_dir():
            raise FileNotFoundError(f"features: labels must be a folder, got {labels}")
        folder, faults = open_labels(Path(labels))
        errors = [fault for fault in faults if fault.severity == "error"]
        if errors:
            raise SceneError(errors[0], len(errors) - 1)
        if not isinstance(folder, DenseFolder):
            raise ValueError(
                f"features: labels must be a class for each pixel (classes.json and <stem>.png), got others in {labels}"
            )
        known = read_vocabulary(Path(words))
        lacking = [name for name in folder.classes if name not in known.names]
        if lacking:
            raise ValueError(
                f"features: words must have a vector for every class of {labels}, got none for {', '.join(lacking[:5])} in {words}"
            )
        rows = [known.names.index(name) for name in folder.classes]
        self.files = (labels, words)
        self.vocabulary = known
        self.labels = folder
        self.noise = noise.resolve("hard")
        self.seed = seed
        self.text = known.vectors.double().numpy()[rows]
        self._gap, self._meanings = _directions(self.text)

    def identity(self) -> Mapping[str, str]:
        """Hashes of the labels and of the words."""
        labels, words = self.files
        return {
            "labels": folder_digest(labels, "features.extractor.labels"),
            "words": file_digest(words, "features.extractor.words"),
        }

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], stem: str) -> MaskFeatures:
        """See `vlgs.features.Extractor`; of the photograph only name and size matter.

        Raises:
            ValueError: If it has no labels, or they have another shape.
            SceneError: If they cannot be read.
        """
        if stem not in self.labels.files:
            raise ValueError(f"features: labels must hold {stem}.png, got none in {self.files[0]}")
        classes = _resized(self.labels.read_ids(stem), image.shape[:2], stem)
        regions, names = self._regions(classes)
        made = view_masks(
            regions,
            names,
            self.labels.classes,
            self.noise,
            (self.seed, zlib.crc32(stem.encode())),
            self._describe,
            self.text.shape[1],
        )
        first = np.cumsum([0, *(len(level.vectors) for level in made)])
        ids = [np.where(m.index >= 0, m.index + f, -1) for m, f in zip(made, first, strict=False)]
        return MaskFeatures(
            np.stack(ids).astype(np.int32), np.concatenate([level.vectors for level in made])
        )

    def _regions(
        self, classes: UInt8[np.ndarray, "h w"]
    ) -> tuple[Mapping[int, Int[np.ndarray, "h w"]], Mapping[int, Mapping[int, Region]]]:
        """Levels 1 to 3 -> number of the region of every pixel, and what the regions are; 0 is what has no class."""
        from scipy import ndimage

        whole = np.where(classes == IGNORE_ID, 0, classes.astype(np.int64) + 1)
        part, subpart = np.zeros_like(whole), np.zeros_like(whole)
        words = {number: self.labels.classes[number - 1] for number in np.unique(whole[whole > 0])}
        names: dict[int, dict[int, Region]] = {1: {}, 2: {}, 3: {}}
        for number, word in words.items():
            names[3][int(number)] = Region(word, word)
            pieces = np.zeros(whole.shape, np.int32)
            ndimage.label(whole == number, np.ones((3, 3), bool), output=pieces)
            for piece in range(1, int(pieces.max()) + 1):
                own = len(names[2]) + 1
                names[2][own] = Region(word, word)
                rows, columns = np.nonzero(pieces == piece)
                part[rows, columns] = own
                quarter = 2 * (rows > np.median(rows)) + (columns > np.median(columns))
                subpart[rows, columns] = 4 * own + quarter
                names[1] |= {4 * own + q: Region(word, word) for q in range(4)}
        return {1: subpart, 2: part, 3: whole}, names

    def _describe(
        self, word: str, piece: str, level: int, noise: float, rng: np.random.Generator
    ) -> Float[np.ndarray, " e"]:
        """A class's text vector beside the text, with noise of which half the energy lies where the classes differ."""
        inner = rng.normal(size=len(self._meanings)) / np.sqrt(2 * max(len(self._meanings), 1))
        outer = rng.normal(size=self.text.shape[1]) / np.sqrt(2 * self.text.shape[1])
        vector = self.text[self.labels.classes.index(word)] + _MODALITY * self._gap
        vector = vector + noise * (inner @ self._meanings + outer)
        return vector / np.linalg.norm(vector)


def _directions(
    text: Float[np.ndarray, "c e"],
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, "r e"]]:
    """A fixed unit vector at right angles to all text, and orthonormal rows that span the differences of the classes."""
    span = _orthonormal(text)
    gap = np.random.default_rng(_SPACE).normal(size=text.shape[1])
    gap -= span.T @ (span @ gap)
    return gap / max(np.linalg.norm(gap), 1e-12), _orthonormal(text[1:] - text[:1])


def _orthonormal(rows: Float[np.ndarray, "n e"]) -> Float[np.ndarray, "r e"]:
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    return basis[sizes > _PARALLEL]


def _resized(
    classes: UInt8[np.ndarray, "h w"], size: tuple[int, ...], stem: str
) -> UInt8[np.ndarray, "h2 w2"]:
    """Labels at the size of a photograph, the nearest pixel each.

    Raises:
        ValueError: If they have another shape.
    """
    height, width = classes.shape
    if abs(width * size[0] - height * size[1]) > max(height, width):
        raise ValueError(
            f"features: labels of {stem} must have the photograph's shape, {size[1]} x {size[0]}, got {width} x {height}"
        )
    y, x = ((np.arange(n) * m + m // 2) // n for n, m in zip(size, (height, width), strict=True))
    return classes[y[:, None], x]
