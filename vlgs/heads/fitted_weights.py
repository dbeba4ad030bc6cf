"""Weights of a fit that are kept, with their digest: without it a flipped bit would go into every result, unnoticed."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from vlgs.files import write_atomically


def write_weights(path: Path, state: Mapping[str, Tensor]) -> None:
    """Keep a state dict, whole or not at all.

    Raises:
        OSError: If the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, save(dict(state), {"digest": _digest(state)}))


def read_weights(path: Path) -> dict[str, Tensor]:
    """What `write_weights` wrote.

    Raises:
        ValueError: If the weights are not those that were written.
        SafetensorError: If it is no file of weights.
        OSError: If it cannot be read.
    """
    if path.exists() and not path.is_file():  # a pipe would be waited for without end
        raise ValueError("it is no file")
    with path.open("rb"):  # says why a file cannot be opened
        pass
    with safe_open(path, framework="pt") as file:
        digest = (file.metadata() or {}).get("digest")
        state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (no __iter__)
    if digest != _digest(state):
        raise ValueError("it does not match its digest")
    return state


def _digest(state: Mapping[str, Tensor]) -> str:
    """Hash of names, types, shapes and values: safetensors sorts them, and without metadata equal weights are equal bytes."""
    return hashlib.blake2b(save(dict(state)), digest_size=16).hexdigest()
