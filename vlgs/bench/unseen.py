"""Quality of views that were never photographed: between, beyond and above the training views, under a sky, before a plain wall."""

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, cast

import torch
from hydra.utils import get_object
from omegaconf import DictConfig

from vlgs.bench.lonely import share_lonely
from vlgs.bench.presets import composed
from vlgs.bench.quality import score
from vlgs.bench.record import provenance, read_record, say, show, write_record
from vlgs.bench.shown import capture_of, psnr_shown, shown_pixels
from vlgs.bench.unseen_draw import draw_unseen
from vlgs.bench.unseen_row import UnseenRow
from vlgs.data.synthetic import load_scene
from vlgs.experiment import construct
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import SplatField
from vlgs.identity import RESULTS_VERSION
from vlgs.prepare import Prepared, make_workshop, prepare
from vlgs.report.provenance import commit
from vlgs.runs import RunFolder
from vlgs.training.stages import run_stages
from vlgs.training.workshop import StoppedError
from vlgs.types import Scene

PROCEDURAL = ("glassware_ring", "mirrors_sky", "lookalikes_wall")
"""In a room, under a sky, before a plain wall."""
TRAIN_VIEWS = (12, 20, 40)
PHOTOGRAPHS = ("fox", "dtu_scan65", "camvid_0016E5")
"""Folders below `--root`; a folder that is not there is left out."""
SPLITS = ("every 8th", "a tenth", "12 photographs")
"""What is held out of photographs: the tenth is contiguous; the last are what is trained on, spread over those that every 8th leaves."""
HELD_OUT = 8
SIZE = ("data.width=120", "data.height=90")
QUICK = ("data.width=48", "data.height=36", "data.points=400", "trainer=smoke")  # fmt: skip


@dataclass(frozen=True)
class Task:
    """What is trained, up to the seed and the recipe."""

    scene: str
    split: str
    overrides: tuple[str, ...]


def make_tasks(
    scenes: Sequence[str],
    views: Sequence[int],
    root: Path | None,
    resize: float,
    quick: bool,
    splits: Sequence[str] = SPLITS,
) -> list[Task]:
    """Procedural scenes at every number of views; photographs below `root`, with every one of the `splits`.

    Raises:
        ValueError: If a split is unknown, or nothing is left.
    """
    if unknown := sorted({*splits} - {*SPLITS}):
        raise ValueError(f"bench: splits must be among {list(SPLITS)}, got {unknown}")
    small = QUICK if quick else SIZE
    tasks = [
        Task(scene, f"{count} views", (
            f"data.scene={scene}", f"data.train_views={count}", f"data.test_views={min(HELD_OUT, count - 1)}", *small))
        for scene in scenes if scene not in PHOTOGRAPHS
        for count in views
    ]  # fmt: skip
    for scene in (s for s in scenes if s in PHOTOGRAPHS and root is not None):
        assert root is not None
        if not (root / scene).is_dir():
            say(f"{scene}: not below {root}; left out")
            continue
        given = ("data=colmap", f"data.root={root / scene}", f"data.resize={resize}")
        given += QUICK[-1:] if quick else ("trainer=photos",)
        if "every 8th" in splits:
            tasks.append(Task(scene, "every 8th", (*given, "data.split=llff")))
        if "a tenth" in splits:
            tenth = ",".join(_middle_tenth([*given, "data.split=all"]))
            held_out = ("data.split=list", f"data.test=[{tenth}]")
            tasks.append(Task(scene, "a tenth", (*given, *held_out)))
        if "12 photographs" in splits:
            few = ("data.split=llff", "data.train_views=12")
            tasks.append(Task(scene, "12 photographs", (*given, *few)))
    if not tasks:
        raise ValueError(f"bench: scenes must be at least one that is there, got {list(scenes)}")
    return tasks


def recipes_of(
    name: str, overrides: Sequence[str], beside: Sequence[Sequence[str]]
) -> dict[str, Sequence[str]]:
    """Label -> overrides, of the first recipe and of those beside it, each a name and what it changes.

    Raises:
        ValueError: If one beside it has another's name or changes nothing.
    """
    recipes = {name: overrides}
    for label, *changes in beside:
        if label in recipes or not changes:
            raise ValueError(
                f"bench: --beside needs a name of its own and what it changes, got {label!r}"
            )
        recipes[label] = changes
    return recipes


def run_unseen(
    tasks: Sequence[Task],
    recipes: Mapping[str, Sequence[str]],
    seeds: Sequence[int],
    out: Path,
    threads: int,
) -> list[UnseenRow]:
    """Train what has no row yet, seed by seed; write unseen.csv after each, then unseen.png and the table.

    Args:
        tasks: From `make_tasks`.
        recipes: Label -> overrides.
        seeds: Of the training; the scenes stay the same.
        out: Folder of the files.
        threads: Of the training.
    """
    header = provenance(None, seeds=" ".join(map(str, seeds)), training_threads=threads)
    path = out / "unseen.csv"
    rows = _read(path)
    torch.set_num_threads(threads)
    for seed in seeds:
        for task in tasks:
            for label, overrides in recipes.items():
                row = _row(task, label, overrides, seed, threads, {r.run: r for r in rows})
                if row is not None:
                    rows.append(row)
                    write_record(path, rows, header)
    draw_unseen(out / "unseen", rows)
    _print(rows)
    return rows


def _row(
    task: Task,
    label: str,
    overrides: Sequence[str],
    seed: int,
    threads: int,
    known: Mapping[str, UnseenRow],
) -> UnseenRow | None:
    """Train and score, unless a row of this run is known."""
    given = [*task.overrides, *overrides, f"seed={seed}", f"threads={threads}", "progress=false"]
    config = composed(given)
    if "cache_dir" in config.head:
        config.head.cache_dir = None  # its fit is part of the time
    ready = prepare(construct(config))
    if ready.run_id in known:
        return None
    started = time.process_time()
    field = _train(ready)
    seconds = time.process_time() - started
    scene = ready.scene
    scores = score(ready.experiment, scene, field)
    assert scores.psnr is not None
    assert scores.ssim is not None
    views = {name: float(view["psnr"] or 0.0) for name, view in scores.per_view.items()}
    worst = min(views, key=lambda name: views[name])
    lerf = scores.beside.get("miou_lerf_ovs")
    unshown, shown = _of_what_is_shown(config.data, field.model, scene)
    row = UnseenRow(
        task.scene, task.split, label, seed, ready.run_id, RESULTS_VERSION, commit(), scores.psnr, views[worst], worst,
        scores.ssim, scores.miou, None if lerf is None else float(lerf), share_lonely(field.model, scene),
        field.model.count, seconds, unshown, fmean(shown) if shown else None, min(shown, default=None),
    )  # fmt: skip
    say(f"{task.scene}, {task.split}, {label}, seed {seed}: {row.psnr:.2f} dB, worst {row.worst:.2f}, "
        f"mIoU {row.miou}, {row.gaussians} Gaussians, {seconds:.0f} s of CPU")  # fmt: skip
    return row


def _of_what_is_shown(
    data: DictConfig, model: SplatModel, scene: Scene
) -> tuple[float | None, list[float]]:
    """Share of held-out pixels that no training photograph shows, and the PSNR of each view over the others; of procedural scenes."""
    if get_object(data._target_) is not load_scene:
        return None, []
    shown = shown_pixels(capture_of(data))
    share = 1 - float(torch.stack(list(shown.values())).float().mean())
    return share, psnr_shown(model, scene, shown)


def _train(ready: Prepared) -> SplatField:
    """All stages of a run, in a folder that goes again.

    Raises:
        ValueError: If what it makes is not Gaussians of one model.
    """
    with tempfile.TemporaryDirectory() as folder:
        workshop = make_workshop(RunFolder(Path(folder)), ready)
        try:
            field = run_stages(ready.experiment.stages(), ready.scenes, workshop).field()
        except StoppedError as stop:
            raise KeyboardInterrupt from stop
    if not isinstance(field, SplatField):
        raise ValueError(
            f"bench: a recipe must make Gaussians of one model, got {type(field).__name__}"
        )
    return field


def _middle_tenth(overrides: Sequence[str]) -> list[str]:
    names = sorted(view.name for view in construct(composed(overrides)).read_scene().train)
    count = max(1, len(names) // 10)
    first = (len(names) - count) // 2
    return names[first : first + count]


def _read(path: Path) -> list[UnseenRow]:
    if not path.is_file():
        return []
    table = read_record(path).astype(object)
    lines = table.where(table.notna(), None).to_dict(orient="records")
    return [UnseenRow(**cast(dict[str, Any], line)) for line in lines]


@dataclass(frozen=True)
class Summary:
    """A scene over its seeds."""

    scene: str
    split: str
    recipe: str
    results_version: int
    seeds: int
    means: Mapping[str, float | None]
    """Means over seeds, by column of `UnseenRow`; `worst` and `worst_shown` are the worst of all."""
    psnr_spread: float
    """Largest minus smallest mean PSNR of the seeds, dB."""
    miou_spread: float | None


def summary(rows: Sequence[UnseenRow]) -> list[Summary]:
    """One per results version, recipe, scene and split, in the order they came."""
    groups: dict[tuple[int, str, str, str], list[UnseenRow]] = {}
    for row in rows:
        groups.setdefault((row.results_version, row.recipe, row.scene, row.split), []).append(row)
    names = ("psnr", "ssim", "miou", "miou_lerf_ovs", "lonely", "gaussians", "cpu_seconds", "unshown", "psnr_shown")  # fmt: skip
    found = []
    for (version, recipe, scene, split), mine in groups.items():
        values = {name: [getattr(row, name) for row in mine] for name in names}
        means = {name: None if None in them else fmean(them) for name, them in values.items()}
        means["worst"] = min(row.worst for row in mine)
        shown = [row.worst_shown for row in mine if row.worst_shown is not None]
        means["worst_shown"] = min(shown) if len(shown) == len(mine) else None
        psnr, miou = values["psnr"], values["miou"]
        spread = None if None in miou else max(miou) - min(miou)
        found.append(
            Summary(scene, split, recipe, version, len(mine), means, max(psnr) - min(psnr), spread)
        )
    return found


def _print(rows: Sequence[UnseenRow]) -> None:
    def number(value: float | None, digits: int) -> str:
        return "--" if value is None else f"{value:.{digits}f}"

    lines = []
    for s in summary(rows):
        m = s.means
        assert m["lonely"] is not None
        spreads = (s.psnr_spread, s.miou_spread) if s.seeds > 1 else (None, None)
        lines.append(
            (
                s.scene, s.split, f"{s.recipe}, {s.results_version}", f"{s.seeds}", number(m["psnr"], 2),
                number(spreads[0], 2), number(m["worst"], 2), number(m["psnr_shown"], 2), number(m["worst_shown"], 2),
                number(m["ssim"], 3), number(m["miou"], 3),
                number(spreads[1], 3), number(m["miou_lerf_ovs"], 3), number(100 * m["lonely"], 1),
                number(m["gaussians"], 0), number(m["cpu_seconds"], 0),
            )
        )  # fmt: skip
    columns = (
        "scene",
        "trained on",
        "recipe, results version",
        "seeds",
        "PSNR",
        "spread",
        "worst",
        "of what is shown",
        "worst",
        "SSIM",
        "mIoU",
    )
    more = ("spread", "LERF-OVS", "lonely, %", "Gaussians", "CPU s")
    show("unseen views: means over seeds", (*columns, *more), lines)
