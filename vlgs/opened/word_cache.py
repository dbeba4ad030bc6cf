"""Vectors of words that a text tower has encoded before, kept on disk: loading the tower takes seconds, reading a vector none."""

import hashlib
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from vlgs.files import write_atomically
from vlgs.queries.text import ClipText, find_model

_MODEL_FILES = frozenset({".safetensors", ".bin", ".json", ".txt", ".model"})
"""Suffixes of what a vector depends on."""


def cache_folder() -> Path:
    """Where vectors are kept: a folder of ours below XDG_CACHE_HOME, or ~/.cache."""
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(home).expanduser() / "vlgs" / "words"


class CachedText:
    """A text tower in front of which stands a folder of what it has said before.

    Args:
        tower: Encodes what is not there; its `model` says which weights count.
        template: Sentence around a word, with ``{}`` in its place.

    Raises:
        ValueError: If the template has no place for the word.
    """

    def __init__(self, tower: ClipText, template: str = "{}") -> None:
        if template.count("{}") != 1:
            raise ValueError(f"text: template must contain {{}} once, got {template!r}")
        self.tower = tower
        self.template = template

    def encode(self, names: Sequence[str]) -> Float[Tensor, "k e"]:
        """See `vlgs.queries.TextEncoder`.

        Raises:
            ValueError: See `vlgs.queries.text.ClipText`.
            OSError: If the weights are not on this machine.
        """
        weights = _weights_of(self.tower.model)
        paths = {name: cache_folder() / f"{self._key(weights, name)}.safetensors" for name in names}
        rows = {name: _read(path) for name, path in paths.items()}
        for row in rows.values():
            if row is not None:
                self.tower.require_width(len(row))
        new = [name for name, row in rows.items() if row is None]
        if new:
            vectors = self.tower.encode([self.template.replace("{}", name) for name in new])
            for name, vector in zip(new, vectors, strict=True):
                rows[name] = vector
                _write(paths[name], vector)
        return torch.stack([row for name in names if (row := rows[name]) is not None])

    def _key(self, weights: Sequence[str], name: str) -> str:
        text = "\0".join([*weights, self.template, name])
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _weights_of(model: str) -> list[str]:
    """What tells one set of weights from another without reading half a gigabyte: files, their sizes and when they were written.

    Those of the tokenizer and the configuration count too.
    """
    folder = find_model(model)
    if folder is None:
        return [model]  # the tower says what is missing
    files = (path for path in sorted(folder.iterdir()) if path.suffix in _MODEL_FILES)
    found = [(path.name, path.stat()) for path in files if path.is_file()]
    return [model, *(f"{name} {stat.st_size} {stat.st_mtime_ns}" for name, stat in found)]


def _read(path: Path) -> Tensor | None:
    if not path.is_file():
        return None
    try:
        vector = load_file(path).get("vector")
    except (SafetensorError, OSError):
        return None  # it is made anew
    sound = vector is not None and vector.dim() == 1 and bool(vector.isfinite().all())
    return vector if sound else None


def _write(path: Path, vector: Tensor) -> None:
    with suppress(OSError):  # a full or read-only disk costs only the time to encode it again
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, save({"vector": vector.contiguous()}), durable=False)
