"""A folder of language maps: whole pairs of files or none, all made with the same settings."""

import io
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlgs.data.language import VOCABULARY_FILE, MaskFiles, find_mask_files, write_vocabulary
from vlgs.data.untrusted.text import read_json
from vlgs.features.extractor import LEVELS, MaskFeatures
from vlgs.files import write_atomically
from vlgs.types import Vocabulary

SETTINGS = "features.json"


@dataclass(frozen=True)
class FeatureFolder:
    """Where the pairs ``<stem>_f.npy``, ``<stem>_s.npy`` go, and ``features.json`` with what made them."""

    path: Path

    @property
    def has_settings(self) -> bool:
        """Whether the maps are known to be of this program."""
        return (self.path / SETTINGS).is_file()

    def require_same(self, settings: Mapping[str, Any], unknown: Collection[str] = ()) -> None:
        """Do nothing if the folder is empty or was made with these settings.

        Args:
            settings: Of the maps.
            unknown: Keys that are not compared.

        Raises:
            ValueError: If it was made with others (it says which), or its maps were made by another program.
        """
        file = self.path / SETTINGS
        if not self.has_settings:
            if self.path.is_dir() and any(self.path.glob("*_[sf].npy")):
                raise ValueError(
                    f"features: {self.path} must be empty or have a {SETTINGS}, got language maps of another program; "
                    "choose another folder: features.out=FOLDER"
                )
            return
        try:
            before = read_json(file, "a JSON of settings")
            if not isinstance(before, dict):
                raise TypeError(f"{type(before).__name__} instead of a mapping")
        except TypeError as error:
            raise ValueError(f"{file}: content must be a JSON of settings, got {error}") from error
        old, new = (
            _flat({key: value for key, value in each.items() if key not in unknown})
            for each in (before, settings)
        )
        changed = sorted(k for k in old.keys() | new.keys() if old.get(k) != new.get(k))
        if changed:
            differences = "; ".join(f"{k} was {old.get(k)}, is {new.get(k)}" for k in changed[:8])
            more = f" and {len(changed) - 8} more" if len(changed) > 8 else ""
            raise ValueError(
                f"features: settings must be those that {self.path} was made with, got {differences}{more}; "
                "choose another folder with features.out=FOLDER, or delete this one"
            )

    def claim(self, settings: Mapping[str, Any]) -> None:
        """Make the folder and write down the settings.

        Raises:
            ValueError: As `require_same`.
        """
        self.require_same(settings)
        self.path.mkdir(parents=True, exist_ok=True)
        file = self.path / SETTINGS
        if not file.is_file():
            text = json.dumps(settings, indent=2, sort_keys=True) + "\n"
            write_atomically(file, text.encode())

    def has(self, stem: str) -> bool:
        """Whether a photograph is done."""
        return find_mask_files(self.path, stem) is not None

    def write(self, stem: str, features: MaskFeatures) -> None:
        """Write both files of a photograph.

        The vectors first: readers take a pair for there only when it has ids, so a crash in between leaves none. Ids that a
        lost half left behind go before, so that they never stand beside new vectors.
        """
        files = MaskFiles(self.path / f"{stem}_s.npy", self.path / f"{stem}_f.npy")
        files.ids.unlink(missing_ok=True)
        write_atomically(files.vectors, _npy(features.vectors))
        write_atomically(files.ids, _npy(features.ids.astype(np.float32)))

    def write_words(self, vocabulary: Vocabulary) -> None:
        """Write what can be asked of these maps; a file that is there, such as one of more words, stays."""
        if not (self.path / VOCABULARY_FILE).exists():
            write_vocabulary(self.path / VOCABULARY_FILE, vocabulary)


def pair_bytes(size: tuple[int, int], vectors: int, width: int) -> int:
    """Bytes of the two files of a photograph.

    Args:
        size: Height and width.
        vectors: Masks of all levels.
        width: Of a vector.
    """
    return 4 * (LEVELS * size[0] * size[1] + vectors * width) + 2 * 128


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _flat(node: Any, key: str = "") -> dict[str, Any]:
    """Nested mappings as one of dotted keys; values as JSON gives them back."""
    if isinstance(node, Mapping):
        items = (_flat(child, f"{key}.{name}") for name, child in node.items())
        return {k: v for part in items for k, v in part.items()}
    return {key.lstrip("."): list(node) if isinstance(node, tuple) else node}
