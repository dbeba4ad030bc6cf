"""Time and peak memory of each stage before the first training step, with many large photographs."""

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from vlgs.bench.child import Child, peak_mib

if TYPE_CHECKING:
    from vlgs.training.lightning import VLGSModule

DISTINCT = 10
"""Photographs and maps of masks that differ; the others are further names of them, and are read and hashed like any other.
The masks' vectors all differ: equal ones would make the head's work less than it is."""
MASKS = (30, 120, 80, 40)
"""Masks of a photograph at the four levels."""
POINTS = 50_000
STEPS = 3


Language = Literal["none", "head fitted", "head cached"]
"""Whether there is language, and whether its head, the first stage of training, is there from a run before."""


@dataclass(frozen=True)
class Reached:
    """Where a process has come to, since it was started."""

    language: Language
    images: int
    width: int
    height: int
    stage: str
    wall_seconds: float
    cpu_seconds: float
    peak_mib: float
    """Most memory that the process has held so far."""


def run_reading(images: int, size: tuple[int, int], out: Path, seed: int) -> list[Reached]:
    """Write scenes to a scratch folder, train on them for a moment in processes of their own, and write reading.csv."""
    from vlgs.bench.record import provenance, show, write_record

    notes = f"files are in the page cache; photographs and maps of masks repeat after {DISTINCT}"
    header = provenance(seed, note=notes)
    rows: list[Reached] = []
    with tempfile.TemporaryDirectory(prefix="vlgs-reading-") as scratch:
        for language in get_args(Language):
            root = Path(scratch) / ("photographs" if language == "none" else "with_language")
            if not root.is_dir():
                write_photographs(root, images, size, language != "none", seed)
            started = time.time()
            with Child() as child:
                for stage, *reached in child.call(stages, root, started, Path(scratch) / "heads"):
                    rows.append(Reached(language, images, *size, stage, *reached))
    write_record(out / "reading.csv", rows, header)
    show(
        f"{images} photographs of {size[0]} x {size[1]}",
        ("language, stage", "wall s", "CPU s", "peak MiB"),
        [
            (
                f"{row.language}, {row.stage}",
                f"{row.wall_seconds:.1f}",
                f"{row.cpu_seconds:.1f}",
                f"{row.peak_mib:.0f}",
            )
            for row in rows
        ],
    )
    return rows


def stages(root: Path, started: float, heads: Path) -> list[tuple[str, float, float, float]]:
    """What `python -m vlgs.run data=colmap data.root=ROOT trainer=photos` does up to its first steps.

    Args:
        root: Scene.
        started: `time.time()` at the start of this process.
        heads: Folder that fitted heads are kept in.

    Returns:
        Stage, and from its wall seconds on the columns of `Reached`.
    """
    from vlgs.bench.presets import build, composed
    from vlgs.experiment import construct

    rows: list[tuple[str, float, float, float]] = []

    def reach(stage: str) -> None:
        rows.append((stage, time.time() - started, time.process_time(), peak_mib()))

    options = ["data=colmap", f"data.root={root}", "trainer=photos", f"head.cache_dir={heads}"]
    experiment = construct(composed(options))
    reach("imports")
    scene = experiment.read_scene()
    reach("scene read")
    module = build(experiment, scene)
    reach("Gaussians and head")
    for stage, work in _training(module):
        work()
        reach(stage)
    return rows


def _training(module: "VLGSModule") -> Iterator[tuple[str, Callable[[], object]]]:
    def decode() -> None:
        for index in range(len(module.views.scene.train)):
            module.views[index]

    yield "first step", lambda: module.training_step(0, 0)
    yield "every view decoded once", decode
    yield f"{STEPS} more steps", lambda: [module.training_step(i, 0) for i in range(1, STEPS + 1)]


def write_photographs(
    root: Path, images: int, size: tuple[int, int], language: bool, seed: int
) -> None:
    """A COLMAP scene of smooth noise: cameras on a circle, points in the middle, four levels of masks."""
    from PIL import Image

    from vlgs.data.sparse import SparseCamera, SparseImage, SparseModel
    from vlgs.data.sparse.write import write_colmap

    (root / "images").mkdir(parents=True)
    rng, (width, height) = np.random.default_rng(seed), size
    names = [f"frame_{i + 1:05d}" for i in range(images)]
    for i, name in enumerate(names):
        path = root / "images" / f"{name}.jpg"
        if i >= DISTINCT:
            os.link(root / "images" / f"{names[i % DISTINCT]}.jpg", path)
            continue
        coarse = Image.fromarray(rng.integers(0, 256, (height // 8, width // 8, 3), np.uint8))
        coarse.resize(size, Image.Resampling.BICUBIC).save(path, quality=92)
    angles = 2 * np.pi * np.arange(images) / images
    views = [
        SparseImage(
            i + 1, 1, f"{name}.jpg", (np.cos(a / 2), 0.0, np.sin(a / 2), 0.0), (0.0, 0.0, 4.0), -1
        )
        for i, (name, a) in enumerate(zip(names, angles, strict=True))
    ]
    camera = SparseCamera(1, "PINHOLE", width, height, (width, width, width / 2, height / 2))
    ids, points = np.arange(POINTS) + 1, rng.normal(size=(POINTS, 3))
    colors = rng.integers(0, 256, (POINTS, 3)).astype(np.uint8)
    model = SparseModel(root, "noise", (camera,), tuple(views), ids, points, colors)
    write_colmap(root / "sparse" / "0", model)
    if language:
        _write_masks(root / "language_features", names, size, rng)


def _write_masks(
    folder: Path, names: list[str], size: tuple[int, int], rng: np.random.Generator
) -> None:
    from PIL import Image

    from vlgs.data.language import write_mask_files

    folder.mkdir()
    for i, name in enumerate(names):
        levels, first = [], 0
        for count in MASKS:
            cells = rng.integers(-1, count, (12, 16)).astype(np.int32)
            ids = np.asarray(Image.fromarray(cells).resize(size, Image.Resampling.NEAREST))
            levels.append(np.where(ids >= 0, ids + first, -1))
            first += count
        vectors = rng.normal(size=(first, 512))
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        if i < DISTINCT:
            write_mask_files(folder, name, np.stack(levels), vectors)
            continue
        os.link(folder / f"{names[i % DISTINCT]}_s.npy", folder / f"{name}_s.npy")
        np.save(folder / f"{name}_f.npy", vectors.astype(np.float32))
