"""From a folder of photographs to a scene that ``data=colmap`` reads, or to nothing at all."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vlgs.data.diagnostics import listing
from vlgs.files import write_atomically
from vlgs.sfm.photographs import digest_photographs, find_photographs
from vlgs.sfm.result import REPORT, Reconstruction, count_apart, read_finished

_EXHAUSTIVE_UP_TO = 120
"""Photographs beyond which matching=auto goes through them in order: 120 make 7140 pairs."""


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """How cameras are found.

    Raises:
        ValueError: If an option is out of range.
    """

    matching: str = "auto"
    """exhaustive (every pair), sequential (neighbours by name: a video), auto (by number of photographs)."""
    overlap: int = 10
    """Neighbours on each side, with matching=sequential."""
    camera_model: str = "SIMPLE_RADIAL"
    """A model of COLMAP's; OPENCV for strong distortion."""
    single_camera: bool | None = None
    """Whether one camera took them all; None: one took those of one size and one camera and focal length in their EXIF."""
    max_size: int = 3200
    """Larger photographs are shrunk to this for finding features."""
    max_features: int = 8192
    """In one photograph."""
    undistort: bool = False
    """Whether photographs are written as a pinhole camera sees them. vlgs does that itself, with one interpolation less."""
    threads: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        if self.matching not in ("auto", "exhaustive", "sequential"):
            raise ValueError(
                f"sfm: matching must be auto, exhaustive or sequential, got {self.matching}"
            )
        if min(self.overlap, self.threads, self.max_size, self.max_features) < 1 or self.seed < 0:
            raise ValueError(f"sfm: numbers must be positive, got {self}")


def reconstruct(images: Path, out: Path, options: SfmOptions, console: Console) -> Reconstruction:
    """Find the cameras of all photographs of a folder and write a scene; one that is there is only reported.

    The work lies in ``.<out>.sfm`` beside the scene until that is whole; the same call takes up what is there.

    Args:
        images: Folder of photographs; subfolders count.
        out: Folder to be made: ``images/``, ``sparse/0/`` and ``sfm.json``.
        options: How.
        console: For the progress bar.

    Raises:
        FileNotFoundError: If there is no such folder.
        FileExistsError: If `out` is there already, and neither empty nor what this call would make.
        ValueError: If photographs cannot be read, or no cameras are found; it says what to do.
        RuntimeError: If COLMAP stops; it says where its log is.
    """
    by_device = find_photographs(images)
    groups = list(by_device.values())
    names = sorted(name for group in groups for name in group)
    chosen = asdict(options)
    if options.single_camera:
        if len(sizes := {size for size, _ in by_device}) > 1:
            listed = listing(f"{width} x {height}" for width, height in sorted(sizes))
            raise ValueError(
                f"sfm: --single-camera must have photographs of one size, got {listed}"
            )
        groups = [names]
    if options.matching == "auto":
        many = len(names) > _EXHAUSTIVE_UP_TO
        chosen["matching"] = "sequential" if many else "exhaustive"
    digest = digest_photographs(images, names)
    options_made = {k: v for k, v in chosen.items() if k != "threads"}
    made = {"options": options_made, "names": names, "photographs": digest}
    if out.exists() and (found := read_finished(out, made)) is not None:
        console.print("this scene exists, nothing was computed")
        return found
    place = out.resolve()
    if place.is_relative_to(images.resolve()):
        raise ValueError(f"sfm: OUT must lie outside of the photographs in {images}, got {out}")
    work = place.with_name(f".{place.name}.sfm")
    taken = {"names": names, "groups": groups, "photographs": digest}
    _prepare(work, {**chosen, "images": str(images.resolve()), **taken}, console)
    _run(work, console, len(names), _pairs(len(names), chosen["matching"], options.overlap))
    models = json.loads((work / "models.json").read_text(encoding="utf-8"))
    if not models:
        raise ValueError(
            f"sfm: photographs must overlap, got no two of {len(names)} in {images} that COLMAP could join; {ADVICE}"
        )
    best = max(models, key=lambda model: len(model["registered"]))
    registered = set(best["registered"])
    result = Reconstruction(
        photographs=len(names),
        registered=len(registered),
        points=best["points"],
        reprojection_error=best["reprojection_error"],
        apart=count_apart(registered, [set(model["registered"]) for model in models]),
        missing=tuple(name for name in names if name not in registered),
        cameras=best["cameras"],
        devices=len(groups),
    )
    sparse = work / "sparse" / best["folder"]
    _assemble(work, sparse, None if options.undistort else images, place, (result, made))
    return result


ADVICE = (
    "take photographs in which each thing is seen from several places (move, do not only turn), sharp and with at least 60 % "
    "overlap; use --matching exhaustive if names are not in order, --overlap 20 for a fast video, --camera OPENCV for a wide "
    "lens, --max-features 16384 for plain walls; leave out blurred ones"
)


def _prepare(work: Path, settings: dict[str, Any], console: Console) -> None:
    """The work folder, emptied if it was for other settings."""
    file = work / "settings.json"
    text = json.dumps(settings, indent=2)
    if file.is_file():
        if changed := _changed(file, settings):
            console.print(f"earlier work in {work} is deleted; changed: {changed}")
            shutil.rmtree(work)
    elif work.is_dir() and any(work.iterdir()):
        raise FileExistsError(f"sfm: {work} must be a folder of an earlier run, got other files")
    work.mkdir(parents=True, exist_ok=True)
    write_atomically(file, text.encode())


def _changed(file: Path, settings: dict[str, Any]) -> str:
    """Names of the settings that are not those of a file, but for what moves no camera; empty if there are none."""
    try:
        before = dict(json.loads(file.read_text(encoding="utf-8")))
    except (ValueError, TypeError):
        return file.name
    before.setdefault("photographs", settings.get("photographs"))  # earlier versions have none
    keys = sorted((before.keys() | settings.keys()) - {"threads"})
    return ", ".join(key for key in keys if before.get(key) != settings.get(key))


def _run(work: Path, console: Console, photographs: int, pairs: int) -> None:
    """Start the worker and watch what it has done until it ends."""
    stages = {"features": photographs, "matches": pairs, "mapping": photographs}
    (work / "stage.txt").unlink(missing_ok=True)
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    command = [sys.executable, "-P", str(Path(__file__).with_name("worker.py")), str(work)]
    with (work / "log.txt").open("wb") as log, Progress(*columns, console=console) as bar:
        tasks = {
            name: bar.add_task(name, total=total, start=False) for name, total in stages.items()
        }
        worker = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            started: set[str] = set()
            while True:
                ended = worker.poll() is not None
                for name, done in _done(work):
                    if name not in started:
                        bar.start_task(tasks[name])
                        started.add(name)
                    bar.update(tasks[name], completed=min(done, stages[name]))
                if ended:
                    break
                time.sleep(0.2)
        finally:
            if worker.poll() is None:
                worker.terminate()
                with suppress(subprocess.TimeoutExpired):
                    worker.wait(timeout=10)
                worker.kill()
    if worker.returncode != 0 or _stage(work) != "done":
        lines = (work / "log.txt").read_text(encoding="utf-8", errors="replace").splitlines()
        last = next((line.strip() for line in reversed(lines) if line.strip()), "nothing")
        how = (
            f"signal {-worker.returncode}"
            if worker.returncode < 0
            else f"status {worker.returncode}"
        )
        raise RuntimeError(
            f"sfm: COLMAP must end well, got {how} at stage {_stage(work)}: {last}; its log is {work / 'log.txt'}, the same "
            "command goes on from what is there"
        )


def _done(work: Path) -> Iterator[tuple[str, int]]:
    """Stage -> what the worker has done of it, for the stages that began."""
    stage = _stage(work)
    if stage == "not started":
        return
    database = work / "database.db"
    if database.is_file():
        # Read while it is written: where it is locked, the next look tells.
        with (
            suppress(sqlite3.Error),
            closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True)) as base,
        ):
            yield "features", base.execute("SELECT COUNT(*) FROM keypoints").fetchone()[0]
            if stage != "features":
                rows = base.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0]
                yield "matches", rows
    registered = work / "registered.txt"
    if stage in ("mapping", "undistortion", "done") and registered.is_file():
        yield "mapping", registered.stat().st_size + 1  # the first call is for two


def _stage(work: Path) -> str:
    with suppress(OSError):
        return (work / "stage.txt").read_text(encoding="utf-8") or "not started"
    return "not started"


def _pairs(count: int, matching: str, overlap: int) -> int:
    """Pairs that COLMAP matches."""
    if matching == "exhaustive":
        return count * (count - 1) // 2
    apart = {*range(1, overlap + 1), *(2**i for i in range(overlap))}
    return sum(max(0, count - distance) for distance in apart)


def _assemble(
    work: Path,
    sparse: Path,
    images: Path | None,
    out: Path,
    report: tuple[Reconstruction, dict[str, Any]],
) -> None:
    """Put the scene together beside the work and move it to its place in one step.

    All photographs go along, so that `vlgs.check` can name those without a camera. Where `images` is None they are the
    undistorted ones.
    """
    scene = work / "scene"
    shutil.rmtree(scene, ignore_errors=True)
    if images is None:
        scene.mkdir()
        shutil.copytree(work / "undistorted" / "images", scene / "images")
        sparse = work / "undistorted" / "sparse"
    else:
        for name in json.loads((work / "settings.json").read_text(encoding="utf-8"))["names"]:
            target = scene / "images" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(images / name, target)
    shutil.copytree(sparse, scene / "sparse" / "0")
    result, made = report
    text = json.dumps({**asdict(result), "made": made}, indent=2) + "\n"
    write_atomically(scene / REPORT, text.encode())
    os.sync()
    scene.rename(out)
    shutil.rmtree(work, ignore_errors=True)
