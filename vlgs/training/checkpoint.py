"""Checkpoints: one safetensors file each. A file that is incomplete or damaged is never used.

A file is written under a temporary name and then renamed; its header has a digest of the content. The two newest files are kept,
and if the newer one is damaged the older one is used. Nothing is ever unpickled.
"""

import hashlib
import json
import logging
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vlgs.files import write_atomically

log = logging.getLogger(__name__)

FORMAT = "vlgs-checkpoint-2"
FIRST_FORMAT = "vlgs-checkpoint-1"
"""Format of the first checkpoints, whose digest is in ``latest.json`` beside them."""
KEPT = 2
_NAME = re.compile(r"step_(\d+)\.safetensors")


@dataclass(frozen=True)
class Checkpoint:
    """State of a run after `step` iterations."""

    step: int
    tensors: dict[str, Tensor]
    meta: dict[str, Any]
    """JSON values only."""


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint, and keep only the newest of the earlier ones.

    Raises:
        OSError: If the disk is full or read-only; the previous checkpoint is then untouched.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"step_{checkpoint.step:08d}.safetensors"
    write_atomically(path, encode(checkpoint))
    with suppress(OSError):
        keep_from(folder, checkpoint.step)
    return path


def encode(checkpoint: Checkpoint, form: str = FORMAT) -> bytes:
    """The content of a file: tensors, meta and a digest of both; equal checkpoints are equal bytes.

    Args:
        checkpoint: Step, tensors and JSON values.
        form: Name and version of what they mean.
    """
    from safetensors.torch import save

    tensors = {key: value.detach().contiguous() for key, value in checkpoint.tensors.items()}
    step, meta = str(checkpoint.step), json.dumps(checkpoint.meta)
    header = {"format": form, "step": step, "meta": meta, "digest": _digest(step, meta, tensors)}
    # One entry, because safetensors writes several in random order.
    return save(tensors, {"vlgs": json.dumps(header)})


def load_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest checkpoint that is sound; None where there is none at all.

    Raises:
        ValueError: If checkpoints are there but none of them is sound.
    """
    problems: list[str] = []
    candidates = _candidates(folder)
    for path in candidates:
        try:
            checkpoint = decode(path)
        except (ValueError, OSError) as error:
            problems.append(f"{path.name} {error}")
            continue
        if problems:
            log.warning("checkpoint: %s; %s is taken instead", "; ".join(problems), path.name)
        return checkpoint
    if not candidates:
        return None
    raise ValueError(
        f"checkpoint: {folder} must hold a sound file, got {'; '.join(problems)}; without the folder the run starts anew"
    )


def checkpoint_bytes(folder: Path) -> int:
    """Size of the newest checkpoint; 0 if somebody has removed it."""
    return next((path.stat().st_size for path in _candidates(folder)), 0)


def keep_from(folder: Path, step: int) -> None:
    """Keep the checkpoint of a step and the one before; those of later steps, if an earlier one had to be taken, are damaged."""
    kept = [path for path in _candidates(folder) if _step(path) <= step][:KEPT]
    for path in _candidates(folder):
        if path not in kept:
            path.unlink()


def _candidates(folder: Path) -> list[Path]:
    """Newest first."""
    found = [path for path in folder.glob("step_*.safetensors") if _NAME.fullmatch(path.name)]
    return sorted(found, key=_step, reverse=True)


def _step(path: Path) -> int:
    match = _NAME.fullmatch(path.name)
    assert match  # `_candidates`
    return int(match[1])


def decode(path: Path, form: str = FORMAT) -> Checkpoint:
    """Read what `encode` wrote.

    Raises:
        ValueError: If it is something else or damaged, with what follows the file's name in a sentence.
        OSError: If it cannot be read.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise ValueError("is no file")
    try:
        with safe_open(path, framework="pt") as file:
            outer = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (no __iter__)
    except SafetensorError as error:
        raise ValueError(f"is not a safetensors file ({error})") from error
    try:
        header = json.loads(outer["vlgs"]) if "vlgs" in outer else outer
        written, step, meta = header["format"], header["step"], header["meta"]
        content = json.loads(meta)
    except (json.JSONDecodeError, KeyError, TypeError, RecursionError) as error:
        raise ValueError("has no header of format, step and meta") from error
    if written == form:
        sound = header.get("digest") == _digest(step, meta, tensors)
    elif written == FIRST_FORMAT and form == FORMAT:
        sound = (
            _first_digest(path) == hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()
        )
    else:
        raise ValueError(f"must have format {form}, got {written!r:.80}")
    if not sound:
        raise ValueError("does not match its digest")
    return Checkpoint(int(step), tensors, content)


def _digest(step: str, meta: str, tensors: Mapping[str, Tensor]) -> str:
    """Hash of everything that a checkpoint holds."""
    layout = {key: [str(value.dtype), list(value.shape)] for key, value in tensors.items()}
    digest = hashlib.blake2b(
        json.dumps([step, meta, layout], sort_keys=True).encode(), digest_size=16
    )
    for key in sorted(tensors):
        digest.update(tensors[key].reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _first_digest(path: Path) -> str | None:
    try:
        latest = json.loads((path.parent / "latest.json").read_text())
        return str(latest["blake2b"]) if latest["file"] == path.name else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
