"""Time to reach a score: one learning curve per preset and schedule, on a procedural and a real scene."""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import fmean, median
from typing import TYPE_CHECKING

import pandas as pd
import torch

from vlgs.bench.curve import Curve, curve_path, evaluated_at, seconds_to
from vlgs.bench.memory import peak_bytes
from vlgs.bench.presets import Trained, build, composed
from vlgs.bench.record import (
    COLORS,
    STYLE,
    plain_ticks,
    provenance,
    read_record,
    say,
    show,
    write_figure,
    write_record,
)
from vlgs.experiment import construct
from vlgs.identity import RESULTS_VERSION
from vlgs.places import without_places
from vlgs.runs import RunFolder
from vlgs.skips import SKIPS, turn
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.fit import FitOptions, fit
from vlgs.training.settings import LearningRates

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BASE = ("head.cache_dir=null",)


def _skips(on: bool) -> tuple[str, ...]:
    """Every switch that loses nothing, or no more than its bound, turned on; or every one turned off.

    Two skips turn one key, ``blend_weight``: on, what ``blend_small`` leaves out includes what ``blend_zero`` does; off, the other way
    round. A stop where `early_stop` is on belongs to the preset.
    """
    left = {"early_stop", "blend_zero"} if on else {"blend_small"}
    left |= {skip.name for skip in SKIPS if on and skip.kind == "statistical"}
    return turn((s.name for s in SKIPS if s.switchable and s.name not in left), on)


_RATE = "trainer.learning_rates."
LEVERS: dict[str, tuple[str, ...]] = {
    "paper's rates": (
        "trainer.rates_for=null",
        *(f"{_RATE}{name}={rate:g}" for name, rate in asdict(LearningRates()).items()),
    ),
    "twice the rates of language": (f"{_RATE}features=1e-2", f"{_RATE}indicator_logits=0.1"),
    "rates that stay": ("trainer.color_decay=1",),
    "positions that come to rest": (f"{_RATE}means_final=1.6e-6",),
    "last values": ("trainer.average_color=0", "trainer.average_language=0"),
    "whole views": ("trainer.half_size=0",),
    "harmonics a twentieth": (f"{_RATE}shN=2.5e-4",),
    "3DGS's densification": (
        "gaussians.densify.long_axis=false",
        "gaussians.densify.by_error=false",
    ),
    "what no view shows stays": ("gaussians.densify.prune_unseen=0",),
    "what little light is left counts": ("trainer.transmittance_min=0",),
    "every blended view": ("trainer.skip.blend_reuse=0",),
}
"""What ``trainer=fast`` is without one of its parts, or with language that learns faster."""

RECIPES: dict[str, tuple[str, ...]] = {
    "default": (),
    "exact": ("raster=exact",),
    "trainer=fast": ("trainer=fast",),
    **{f"fast, {name}": ("trainer=fast", *changed) for name, changed in LEVERS.items()},
    "raster=fast": ("raster=fast",),
    "no blend": ("blend=none",),
    "no fusion": ("fusion=none",),
    "neither": ("blend=none", "fusion=none"),
    "neither, fast": ("blend=none", "fusion=none", "raster=fast"),
    "all skips": _skips(on=True),
    "no skips": _skips(on=False),
    "short": ("trainer.iterations=500", "trainer.sh_every=100", "gaussians.densify.start=100", "gaussians.densify.stop=350"),
    "paper": ("trainer=paper",),
    "paper, half size": ("trainer=paper", "trainer.half_size=0.7"),
    "photos": ("trainer=photos",),
    "fast photos": ("trainer=fast_photos",),
}  # fmt: skip
"""Label -> overrides of `python -m vlgs.run`."""

QUICK = ("data.width=48", "data.height=36", "data.train_views=6", "data.test_views=2", "data.points=400",
         "head.training.steps=30", "trainer=smoke")  # fmt: skip
LARGE = ("data.width=986", "data.height=728", "data.train_views=300", "data.points=40000")
"""The procedural scene with the photographs of a scene of LERF: as many, and as large."""


@dataclass(frozen=True)
class Summary:
    """One line of train.csv."""

    scene: str
    size: str
    """WIDTHxHEIGHT of the first training view, in pixels."""
    label: str
    overrides: str
    seed: int
    run: str
    """Run id: its curve is `train/SCENE-RUN.csv`."""
    results_version: int
    iterations: int
    seconds: float
    """Wall clock of all iterations."""
    cpu_seconds: float
    psnr: float | None
    miou: float | None
    gaussians: int
    psnr_target: float | None
    seconds_to_psnr: float | None
    cpu_to_psnr: float | None
    miou_target: float | None
    seconds_to_miou: float | None
    cpu_to_miou: float | None


def scene_overrides(
    root: Path | None,
    resize: float,
    quick: bool,
    synthetic: bool = True,
    further: Sequence[str] = (),
    large: bool = False,
) -> dict[str, tuple[str, ...]]:
    """What `python -m vlgs.run` is told of each scene: the procedural one, and the photographs at `root` where one is given.

    Args:
        root: A scene of `data=colmap`.
        resize: Of the photographs.
        quick: Small and short.
        synthetic: Whether the procedural scene is among them.
        further: Overrides for the photographs: where their language maps are, how they are asked.
        large: Whether the procedural scene is as large as one of LERF.

    Raises:
        ValueError: If there is no scene, or something is said of one that is not there.
    """
    if large and not synthetic:
        raise ValueError(
            "bench: --large must come with the procedural scene, which it is of, got --no-synthetic"
        )
    scenes: dict[str, tuple[str, ...]] = {}
    if synthetic:
        scenes["large" if large else "synthetic"] = QUICK if quick else LARGE if large else ()
    if root is not None:
        photographs = ("data=colmap", f"data.root={root}", f"data.resize={resize}", *further)
        scenes["photographs"] = (*photographs, *(QUICK[-1:] if quick else ()))
    elif further or not synthetic:
        asked = " ".join(further) or "--no-synthetic"
        raise ValueError(f"bench: {asked} must come with --root SCENE, got none")
    else:
        say("no photographs (--root SCENE): the procedural scene alone")
    return scenes


def run_train(
    scenes: dict[str, tuple[str, ...]],
    labels: Sequence[str],
    out: Path,
    points: int,
    threads: int,
    seeds: Sequence[int],
    targets: tuple[float | None, float | None] = (None, None),
) -> list[Summary]:
    """Train what has no curve yet, seed by seed; write train.csv and train.png, print the tables.

    A curve is written when its training ends and is not trained again: its file is named after the run id, so that a change of
    configuration, data or results version gives a new one. Rows of other scenes, sizes, recipes and seeds stay in train.csv while they are
    of the same results version; the picture has the curves of all its rows of the first seed. Without targets they are 1 dB and 0.02 below
    the end of ``default`` (of the first label where it is not among them).
    """
    header = provenance(
        None,
        unit="seconds of training, evaluation and set-up not counted",
        training_threads=threads,
    )
    path, rows = out / "train.csv", []
    for seed in seeds:
        found = {}
        for kind, extra in scenes.items():
            for label in labels:
                overrides = (*extra, *RECIPES[label])
                curve = _curve(kind, label, overrides, out, points, threads, seed)
                found[str(curve.scene.iloc[0]), label] = curve
        rows += _summaries(found, targets, seed)
        written = with_others(path, rows)
        write_record(path, written, header)
        draw_train(out / "train", [row for row in written if row.seed == seeds[0]])
    _print(rows)
    if len(labels) > 1:
        _print_effects(rows, labels[0])
    return rows


def with_others(path: Path, rows: Sequence[Summary]) -> list[Summary]:
    """The rows, after those of the file that are of other trainings and today's results version."""
    if not path.is_file():
        return list(rows)
    table = read_record(path).astype(object)
    if set(table.columns) != {field.name for field in fields(Summary)}:
        return list(rows)
    lines = table.where(table.notna(), None).to_dict(orient="records")
    mine = {_of(row) for row in rows}
    known = [Summary(**{str(key): value for key, value in line.items()}) for line in lines]
    kept = (k for k in known if k.results_version == RESULTS_VERSION and _of(k) not in mine)
    return [*kept, *rows]


def _of(row: Summary) -> tuple[str, str, str, int]:
    """What a training has one row for."""
    return row.scene, row.size, row.label, row.seed


def _curve(
    kind: str,
    label: str,
    overrides: Sequence[str],
    out: Path,
    points: int,
    threads: int,
    seed: int,
) -> pd.DataFrame:
    given = [*BASE, *overrides, f"seed={seed}", f"threads={threads}", "progress=false"]
    experiment = construct(composed(given))
    iterations = experiment.parts.trainer.iterations
    torch.set_num_threads(threads)
    scene = experiment.read_scene()
    name = f"{scene.name}_large" if kind == "large" else scene.name
    run, camera = experiment.run_id(scene.fingerprint), scene.train[0].camera
    known = {"label": label, "size": f"{camera.width}x{camera.height}", "run": run}
    path = curve_path(out / "train", name, run)
    if path.is_file():
        say(f"{name}, {label}: {path} is there")
        return read_record(path).assign(**known)
    say(f"{name}, {label}: {iterations} iterations ...")
    told = " ".join(without_places([*overrides]))
    header = provenance(seed, overrides=told, training_threads=threads)
    trained = Trained(experiment, scene, build(experiment, scene))
    curve = Curve(trained, name, label, evaluated_at(iterations, points))
    with RunFolder(path.with_suffix("")).writing() as folder:
        checkpoint = load_checkpoint(folder.checkpoint)
        if checkpoint is not None:
            curve.resume(checkpoint.meta)
        if fit(trained.module, folder, FitOptions(curve.meta, False, callbacks=[curve])):
            raise KeyboardInterrupt
        curve.evaluate(trained.module)
        peak = (
            f"{peak_bytes() / 2**30:.2f} GiB of memory, scene and what was trained before included"
        )
        write_record(path, curve.points, {**header, "peak": peak})
    shutil.rmtree(folder.path)
    return pd.DataFrame([vars(point) for point in curve.points]).assign(**known)


def _values(curve: pd.DataFrame, column: str) -> list[float | None]:
    return [None if pd.isna(v) else float(v) for v in curve[column]]


def _summaries(
    curves: dict[tuple[str, str], pd.DataFrame],
    targets: tuple[float | None, float | None],
    seed: int,
) -> list[Summary]:
    rows = []
    for scene in dict.fromkeys(scene for scene, _ in curves):
        mine = {label: curve for (where, label), curve in curves.items() if where == scene}
        model = mine.get("default", next(iter(mine.values())))
        psnr, miou = (
            target if target is not None or last is None else last - slack
            for target, last, slack in (
                (targets[0], _values(model, "psnr")[-1], 1.0),
                (targets[1], _values(model, "miou")[-1], 0.02),
            )
        )
        for label, curve in mine.items():
            wall, cpu = list(curve.seconds), list(curve.cpu_seconds)
            psnrs, mious = _values(curve, "psnr"), _values(curve, "miou")
            rows.append(
                Summary(
                    scene, curve["size"].iloc[0], label, " ".join(RECIPES[label]), seed, curve.run.iloc[0], RESULTS_VERSION,
                    int(curve.iteration.iloc[-1]), wall[-1], cpu[-1], psnrs[-1], mious[-1], int(curve.gaussians.iloc[-1]),
                    psnr, seconds_to(psnr, wall, psnrs), seconds_to(psnr, cpu, psnrs),
                    miou, seconds_to(miou, wall, mious), seconds_to(miou, cpu, mious),
                )
            )  # fmt: skip
    return rows


def draw_train(stem: Path, rows: Sequence[Summary]) -> None:
    """PSNR and mIoU of every row against seconds of training, one line of panels per scene and size.

    Args:
        stem: Where the picture goes, without suffix; the curves are in the folder of this name.
        rows: Of one seed. Those whose curve is gone are left out.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    scenes: dict[str, dict[str, pd.DataFrame]] = {}
    looks: dict[str, tuple[str, str]] = {}  # colour and line: a recipe looks alike on every scene
    for row in rows:
        path = curve_path(stem, row.scene, row.run)
        if path.is_file():
            scenes.setdefault(f"{row.scene}, {row.size}", {})[row.label] = read_record(path)
            turn, color = divmod(len(looks), len(COLORS))
            looks.setdefault(row.label, (COLORS[color], ("-", "--", ":")[turn % 3]))
    with rc_context(STYLE):
        figure = Figure(figsize=(8.0, 2.9 * len(scenes)), layout="constrained")
        panels = figure.subplots(len(scenes), 2, squeeze=False)
        for (scene, curves), line in zip(scenes.items(), panels, strict=True):
            line[0].set_title(scene, fontsize=8, loc="left")
            for panel, column, name in zip(
                line, ("psnr", "miou"), ("PSNR, dB", "mIoU"), strict=True
            ):
                _draw_curves(panel, curves, column, looks)
                panel.set_ylabel(f"{name}, held-out views")
            names, labels = line[0].get_legend_handles_labels()
            line[1].legend(names, labels, loc="center left", bbox_to_anchor=(1.0, 0.5))
        write_figure(stem, figure)


def _draw_curves(
    panel: "Axes",
    curves: dict[str, pd.DataFrame],
    column: str,
    looks: dict[str, tuple[str, str]],
) -> None:
    if all(curve[column].isna().all() for curve in curves.values()):
        panel.set_axis_off()
        panel.text(0.5, 0.5, "not scored", ha="center", transform=panel.transAxes)
        return
    for label, curve in curves.items():
        color, ls = looks[label]
        panel.plot(
            curve.seconds, curve[column], marker="o", ms=2.5, lw=1, color=color, ls=ls, label=label
        )
    panel.set_xscale("log")
    plain_ticks(panel.xaxis)
    panel.set_xlabel("seconds of training (wall clock, evaluation not counted)")


def number(value: float | None, digits: int, sign: str = "") -> str:
    """A cell of a table."""
    return "--" if value is None else f"{value:{sign}.{digits}f}"


def _print_effects(rows: Sequence[Summary], first: str) -> None:
    """Every recipe against the first one, scene by scene, seed by seed."""
    base = {(row.scene, row.seed): row for row in rows if row.label == first}
    groups: dict[tuple[str, str], list[tuple[Summary, Summary]]] = {}
    for row in rows:
        if row.label != first:
            groups.setdefault((row.scene, row.label), []).append((row, base[row.scene, row.seed]))
    lines = []
    for (scene, label), pairs in groups.items():
        psnr = [a.psnr - b.psnr for a, b in pairs if a.psnr is not None and b.psnr is not None]
        miou = [a.miou - b.miou for a, b in pairs if a.miou is not None and b.miou is not None]
        cpu = median(a.cpu_seconds / b.cpu_seconds for a, b in pairs)
        count = fmean(a.gaussians / b.gaussians for a, b in pairs)
        lines.append((
            scene, label, f"{len(pairs)}", number(cpu, 2), number(fmean(psnr) if psnr else None, 2, "+"),
            number(fmean(miou) if miou else None, 3, "+"), number(count, 2),
        ))  # fmt: skip
    columns = ("scene", "recipe", "seeds", "CPU, median ratio", "PSNR", "mIoU", "Gaussians, ratio")
    show(f"against {first}, paired by seed; means but for CPU", columns, lines)


def _print(rows: Sequence[Summary]) -> None:
    lines = [
        (
            r.scene, r.label, f"{r.seed}", f"{r.iterations}", f"{r.seconds:.1f}", f"{r.cpu_seconds:.1f}", f"{r.gaussians:,}",
            number(r.psnr, 2), number(r.miou, 3), number(r.seconds_to_psnr, 1), number(r.cpu_to_psnr, 1),
            number(r.seconds_to_miou, 1), number(r.cpu_to_miou, 1),
        )
        for r in rows
    ]  # fmt: skip
    columns = ("scene", "recipe", "seed", "iterations", "s", "CPU s", "Gaussians", "PSNR", "mIoU")
    to = ("s to PSNR", "CPU", "s to mIoU", "CPU")
    show("training: seconds in all and to the targets", (*columns, *to), lines)
    for scene in dict.fromkeys(r.scene for r in rows):
        row = next(r for r in rows if r.scene == scene)
        goals = f"PSNR {number(row.psnr_target, 2)} dB, mIoU {number(row.miou_target, 3)}"
        say(f"targets on {scene}: {goals}")
