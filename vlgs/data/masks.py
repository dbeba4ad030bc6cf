"""The masks of all training views as one table of vectors (`vlgs.types.Scene.mask_vectors`)."""

import hashlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from vlgs.data.diagnostics import Fault, SceneError, listing, warning
from vlgs.data.language import find_mask_files, mask_map_size, read_mask_vectors
from vlgs.data.views import ViewSource, map_sizes


@dataclass(frozen=True)
class ViewMasks:
    """The masks of one view that reach a pixel of it."""

    source: ViewSource
    """The view, now with its mask files."""
    used: Int64[np.ndarray, " u"]
    """Their ids in the view's own file, rising."""
    n_vectors: int
    """Vectors that the view's file has."""
    vectors: Float32[np.ndarray, "u e"]
    areas: Float32[np.ndarray, " u"]
    """Output pixels."""
    digest: bytes
    """Content of map and vectors."""


@dataclass(frozen=True)
class MaskTable:
    """Vectors of the masks that reach a pixel of a training view, at one level."""

    sources: Mapping[str, ViewSource]
    """View -> the view with its masks bound to rows of `vectors`."""
    vectors: Float32[Tensor, "m e"]
    areas: Float32[Tensor, " m"]
    """Output pixels that each vector covers."""
    digest: bytes
    """Content of all that was read."""


def gather_masks(
    views: Sequence[ViewSource], folder: Path, level: int
) -> tuple[MaskTable, tuple[Fault, ...]]:
    """Read the language maps of the training views.

    Only vectors of the chosen level that still cover a pixel after the warp get a row, so that the table holds no vector
    that nothing can be trained on.

    Args:
        views: Training views, in the order in which their vectors are to be stacked.
        folder: With ``<stem>_s.npy`` and ``<stem>_f.npy``.
        level: Mask level, 0 to 3.

    Returns:
        The table and what is wrong with the files that there are. Views without files, or with faulty ones, are not in it.
    """
    found = [(view, find_mask_files(folder, view.name)) for view in views]
    sources = [replace(view, masks=files, level=level) for view, files in found if files]
    faults: list[Fault] = []
    read: list[ViewMasks] = []
    # NumPy and the hash let go of the interpreter.
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for masks in pool.map(_read_or_fault, sources):
            if isinstance(masks, Fault):
                faults.append(masks)
            elif read and masks.vectors.shape[1] != read[0].vectors.shape[1]:
                what = f"vectors must be {read[0].vectors.shape[1]} wide as those of {read[0].source.name}"
                assert masks.source.masks is not None
                path = str(masks.source.masks.vectors)
                faults.append(Fault(path, f"{what}, got {masks.vectors.shape[1]}"))
            else:
                read.append(masks)
    return _stack(read), tuple(faults)


def missing_faults(
    table: MaskTable, views: Sequence[ViewSource], folder: Path, tolerated: bool
) -> Iterator[Fault]:
    """Training views without language maps, all in one fault, and a level at which there are no masks at all."""
    missing = [view.name for view in views if find_mask_files(folder, view.name) is None]
    if missing and (not tolerated or len(missing) == len(views)):
        expected = "<stem>_s.npy and <stem>_f.npy for every training view"
        what = f"language maps must be {expected}, got none for {len(missing)} of {len(views)}"
        advice = f"make those of {listing(missing)}, or set data.allow_missing_masks=true"
        yield Fault(str(folder), what, advice)
    if table.sources and not len(table.vectors):
        yield Fault(str(folder), "masks of the chosen level must reach a pixel, got -1 everywhere")


def stray_faults(folder: Path, stems: Collection[str]) -> Iterator[Fault]:
    """Warnings about files that would not be read: one file of a pair without the other, and maps without a photograph.

    Args:
        folder: Of language maps.
        stems: Of all registered photographs.
    """
    halves = {
        kind: {p.name.removesuffix(f"_{kind}.npy") for p in folder.glob(f"*_{kind}.npy")}
        for kind in "sf"
    }
    for kind, other in ("sf", "fs"):
        if alone := sorted(halves[kind] - halves[other]):
            what = f"language maps must be pairs, got <stem>_{kind}.npy without <stem>_{other}.npy for {listing(alone, 5)}"
            yield warning(folder, what, "neither is read: make them again")
    if stray := sorted((halves["s"] & halves["f"]) - set(stems)):
        what = f"language maps should belong to a registered photograph, got others: {listing(stray, 5)}"
        yield warning(folder, what, "they are not read; maps are matched by the photograph's stem")


def width_warnings(table: MaskTable, folder: Path) -> Iterator[Fault]:
    """Vectors that seem to be codes already."""
    if len(table.vectors) and table.vectors.shape[1] == 3:
        what = "vectors should be those of an encoder (512 wide for CLIP ViT-B/16), got 3 wide"
        advice = (
            "these look like LangSplat's codes (language_features_dim3): take language_features"
        )
        yield warning(folder, what, advice)


def _read_or_fault(source: ViewSource) -> ViewMasks | Fault:
    try:
        return _read_view(source)
    except SceneError as error:
        return error.fault


def _read_view(source: ViewSource) -> ViewMasks:
    """Read and check the files of one view."""
    assert source.masks is not None
    size = mask_map_size(source.masks)
    allowed = map_sizes(source.lens, source.camera_size)
    if size not in allowed:
        expected = " or ".join(f"{width} x {height}" for width, height in allowed)
        what = f"mask map must be {expected} as its image, got {size[0]} x {size[1]}"
        raise SceneError(Fault(str(source.masks.ids), what))
    vectors = read_mask_vectors(source.masks)
    ids = source.read_mask_ids(len(vectors))
    areas = np.bincount(ids.ravel() + 1, minlength=len(vectors) + 1)[1:]
    used = np.flatnonzero(areas)
    own = vectors[used]
    content = hashlib.blake2b(np.ascontiguousarray(ids).data, digest_size=16)
    content.update(own.data)
    covered = areas[used].astype(np.float32)
    return ViewMasks(source, used, len(vectors), own, covered, content.digest())


def _stack(read: Sequence[ViewMasks]) -> MaskTable:
    """Join the vectors of all views in one table."""
    sources, first = {}, 0
    for masks in read:
        rows = np.full(masks.n_vectors + 1, -1, np.int32)
        rows[masks.used + 1] = np.arange(first, first + len(masks.used), dtype=np.int32)
        sources[masks.source.name] = replace(masks.source, rows=rows)
        first += len(masks.used)
    width = read[0].vectors.shape[1] if read else 512
    vectors = np.concatenate([np.zeros((0, width), np.float32), *(m.vectors for m in read)])
    areas = np.concatenate([np.zeros(0, np.float32), *(m.areas for m in read)])
    digest = hashlib.blake2b(b"".join(m.digest for m in read), digest_size=16).digest()
    return MaskTable(sources, torch.from_numpy(vectors), torch.from_numpy(areas), digest)
