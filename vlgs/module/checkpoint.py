"""Checkpoints: one safetensors file with a JSON header, written so that a crash never costs the one before.

A file is complete or it does not exist: it is written under a temporary name, flushed to disk and renamed. `latest.json`
names the newest one and its digest; when it is missing or does not fit, the newest file that reads well is taken.
Nothing is ever unpickled.
"""

import hashlib
import json
import logging
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from vlgs.files import write_atomically

log = logging.getLogger(__name__)

FORMAT = "vlgs-checkpoint-1"


@dataclass(frozen=True)
class Checkpoint:
    """State of a run after `step` iterations."""

    step: int
    tensors: dict[str, Tensor]
    meta: dict[str, Any]
    """JSON values only."""


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint and forget the older ones.

    Raises:
        OSError: If the disk is full or read-only; the previous checkpoint is then untouched.
    """
    from safetensors.torch import save

    folder.mkdir(parents=True, exist_ok=True)
    header = {"format": FORMAT, "step": str(checkpoint.step), "meta": json.dumps(checkpoint.meta)}
    data = save({k: v.detach().contiguous() for k, v in checkpoint.tensors.items()}, header)
    path = folder / f"step_{checkpoint.step:08d}.safetensors"
    write_atomically(path, data)
    latest = {"file": path.name, "step": checkpoint.step, "blake2b": _digest(data)}
    write_atomically(folder / "latest.json", json.dumps(latest, indent=2).encode())
    for old in folder.glob("step_*.safetensors"):
        if old != path:
            with suppress(OSError):
                old.unlink()
    return path


def load_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest checkpoint that reads well; None where there is none.

    Raises:
        ValueError: If checkpoints are there but none of them is readable.
    """
    candidates = sorted(folder.glob("step_*.safetensors"), reverse=True)
    if not candidates:
        return None
    digests = _latest_digest(folder)
    problems = []
    for path in candidates:
        try:
            return _read(path, digests.get(path.name))
        except ValueError as error:
            log.warning("checkpoint: %s; trying the one before", error)
            problems.append(str(error))
    raise ValueError(f"checkpoint: {folder} must hold a readable file, got {'; '.join(problems)}")


def _read(path: Path, digest: str | None) -> Checkpoint:
    from safetensors import SafetensorError, safe_open

    if digest is not None and _digest(path.read_bytes()) != digest:
        raise ValueError(f"{path.name} does not match its digest")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (no __iter__)
    except SafetensorError as error:
        raise ValueError(f"{path.name} is not a safetensors file: {error}") from error
    if header.get("format") != FORMAT:
        raise ValueError(f"{path.name} must have format {FORMAT}, got {header.get('format')}")
    return Checkpoint(int(header["step"]), tensors, json.loads(header["meta"]))


def _latest_digest(folder: Path) -> dict[str, str]:
    try:
        latest = json.loads((folder / "latest.json").read_text())
        return {str(latest["file"]): str(latest["blake2b"])}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
