"""What a run folder keeps for those who open it: its cameras and words from the start, the trained field in the end.

Both are safetensors files with a digest, as checkpoints are (`vlgs.training.checkpoint`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from vlgs.data.sparse import AT_HOME, Origin
from vlgs.fields import Field
from vlgs.fields.saved import MakePart, put_together, take_apart
from vlgs.files import write_atomically
from vlgs.runs import RunFolder
from vlgs.training.checkpoint import Checkpoint, decode, encode
from vlgs.types import Camera, Scene, Vocabulary

T = TypeVar("T")

_SCENE_FORM, _FIELD_FORM = "vlgs-scene-1", "vlgs-field-1"
"""What stands in the files as their format."""
_SPLITS = ("train", "test")
_MOST_PIXELS = 1 << 28
"""Of a camera."""


@dataclass(frozen=True)
class NamedCamera:
    """Where a photograph was taken."""

    name: str
    """Of the photograph, without its suffix."""
    split: str
    """``train`` or ``test``; a photograph that is both stands here twice."""
    camera: Camera


@dataclass(frozen=True)
class SceneNotes:
    """What is known of a scene without its data."""

    name: str
    cameras: tuple[NamedCamera, ...]
    classes: tuple[str, ...]
    """What its labels name."""
    vocabulary: Vocabulary | None
    levels: tuple[int | None, ...]
    """Mask levels, finest first; (None,) where the data have none."""
    origin: Origin = AT_HOME
    """Where in the world of the scene's files its coordinates begin."""


def write_scene(folder: RunFolder, scene: Scene, levels: Sequence[int | None]) -> None:
    """Note the cameras and words of a scene in a run folder.

    Raises:
        OSError: If the disk is full or read-only.
    """
    named = [(split, view) for split in _SPLITS for view in getattr(scene, split)]
    cameras = [view.camera for _, view in named]
    tensors = {
        "viewmats": torch.stack([camera.viewmat for camera in cameras]),
        "Ks": torch.stack([camera.K for camera in cameras]),
        "sizes": torch.tensor([[camera.width, camera.height] for camera in cameras]),
    }
    meta: dict[str, Any] = {
        "name": scene.name,
        "views": [view.name for _, view in named],
        "splits": [split for split, _ in named],
        "classes": list(scene.classes),
        "levels": list(levels),
        "origin": list(scene.origin),
    }
    if scene.vocabulary is not None:
        meta["words"] = list(scene.vocabulary.names)
        tensors["vectors"] = scene.vocabulary.vectors
    content = Checkpoint(0, tensors, meta)
    write_atomically(folder.scene, encode(content, _SCENE_FORM))


def read_scene(folder: RunFolder) -> SceneNotes:
    """What `write_scene` noted.

    Raises:
        ValueError: If the file is not there, damaged or of another version.
    """
    return _read(folder.scene, _SCENE_FORM, _notes_of)


def write_field(folder: RunFolder, field: Field, step: int) -> None:
    """Keep a trained field in a run folder.

    Raises:
        ValueError: If it is of a kind that cannot be kept (`vlgs.fields.saved.take_apart`).
        OSError: If the disk is full or read-only.
    """
    plan, tensors = take_apart(field)
    copies = {name: tensor.clone() for name, tensor in tensors.items()}  # no two share storage
    content = Checkpoint(step, copies, {"plan": plan})
    write_atomically(folder.field, encode(content, _FIELD_FORM))


def read_field(folder: RunFolder, make: MakePart) -> Field:
    """What `write_field` kept.

    Args:
        folder: Of the run.
        make: See `vlgs.fields.saved.put_together`.

    Raises:
        ValueError: If the file is not there, damaged or of another version.
    """
    return _read(folder.field, _FIELD_FORM, lambda content: field_of(content, make))


def field_of(content: Checkpoint, make: MakePart, prefix: str = "") -> Field:
    """The field of a file, or of a checkpoint whose tensors have a prefix.

    Raises:
        ValueError: If they do not make one.
    """
    own = {k.removeprefix(prefix): v for k, v in content.tensors.items() if k.startswith(prefix)}
    plan = content.meta["plan"]
    if "sh_degree" in content.meta:  # of a checkpoint: training raises it
        plan = {**plan, "sh_degree": content.meta["sh_degree"]}
    return put_together(plan, own, make)


def _read(path: Path, form: str, use: Callable[[Checkpoint], T]) -> T:
    if not path.is_file():
        raise ValueError(
            f"{path}: must be there, got none; version 0.1 did not write it: without its metrics.json the run's command reads its "
            "checkpoints again, writes what is missing and trains nothing"
        )
    try:
        return use(decode(path, form))
    except KeyError as error:
        raise ValueError(f"{path}: must have {error}, got none") from error
    except ValueError as error:
        newer = "; another version of vlgs wrote it" if "must have format" in str(error) else ""
        raise ValueError(f"{path}: {error}{newer}") from error


def _notes_of(content: Checkpoint) -> SceneNotes:
    meta, tensors = content.meta, content.tensors
    for name in ("views", "splits", "classes"):
        if not _are(str, meta[name]):
            raise ValueError(f"{name} must be a list of texts")
    if not _are((int, type(None)), meta["levels"]) or not meta["levels"]:
        raise ValueError("levels must be a list of numbers")
    origin = meta.get("origin", list(AT_HOME))  # older files say none
    if not _are((int, float), origin) or len(origin) != 3 or not all(map(isfinite, origin)):
        raise ValueError("origin must be three finite numbers")
    x, y, z = map(float, origin)
    vocabulary = None
    if "words" in meta:
        vectors = tensors["vectors"]
        if not _are(str, meta["words"]) or not _fits(vectors, len(meta["words"]), None):
            raise ValueError("words must be texts, with a vector each")
        vocabulary = Vocabulary(tuple(meta["words"]), vectors)
    cameras = _cameras(tensors, len(meta["views"]))
    named = zip(meta["views"], meta["splits"], cameras, strict=True)
    return SceneNotes(
        str(meta["name"]),
        tuple(NamedCamera(*one) for one in named),
        tuple(meta["classes"]),
        vocabulary,
        tuple(meta["levels"]),
        (x, y, z),
    )


def _cameras(tensors: Mapping[str, Tensor], count: int) -> list[Camera]:
    viewmats, Ks, sizes = (tensors[name] for name in ("viewmats", "Ks", "sizes"))
    if not (count and _fits(viewmats, count, 4, 4) and _fits(Ks, count, 3, 3)):
        raise ValueError(f"viewmats and Ks must be finite matrices of {count} cameras")
    if list(sizes.shape) != [count, 2] or (sizes < 1).any() or (sizes.prod(1) > _MOST_PIXELS).any():
        raise ValueError(f"sizes must be widths and heights of {count} cameras")
    every = zip(viewmats, Ks, sizes.tolist(), strict=True)
    return [Camera(viewmat, K, int(w), int(h)) for viewmat, K, (w, h) in every]


def _fits(tensor: Tensor, *shape: int | None) -> bool:
    """Whether it holds finite float32 numbers in this shape; None stands for any."""
    sides = list(zip(shape, tensor.shape, strict=False))
    same = tensor.dim() == len(shape) and all(want in (None, got) for want, got in sides)
    return same and tensor.dtype == torch.float32 and bool(tensor.isfinite().all())


def _are(kind: type | tuple[type, ...], values: object) -> bool:
    return isinstance(values, list) and all(isinstance(value, kind) for value in values)
