"""Run time against error: presets, switches and precisions of the rasterizer against float64."""

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import torch

from vlgs.bench.checks import Check, check_dense, check_presets, check_rounding, violated
from vlgs.bench.clock import Pass, Spread, spreads, take_turns
from vlgs.bench.memory import Memory, measure_memory
from vlgs.bench.outcome import Errors, RasterOutcome, compare, outcome, time_render, without_cutoffs
from vlgs.bench.presets import Trained, raster_presets
from vlgs.bench.quality import Quality, measure_quality
from vlgs.bench.record import provenance, say, show, write_record
from vlgs.bench.scenes import in_precision, save_workload, view_of, with_one_weight
from vlgs.bench.steps import StepRow, measure_switches
from vlgs.bench.switches import RasterSwitch, check_switch, raster_switches, skipped_share
from vlgs.bench.workload import Workload, make_workload
from vlgs.types import RasterConfig

DTYPES = {"float32": torch.float32, "float64": torch.float64}


class Variant(NamedTuple):
    """One way to render a scene."""

    name: str
    """A preset, or a switch that is not as ``default`` has it."""
    group: str
    """``preset`` or ``switch``."""
    precision: str
    threads: int
    config: RasterConfig
    switch: RasterSwitch | None = None


@dataclass(frozen=True)
class ErrorRow:
    """One line of error.csv."""

    scene: str
    gaussians: int
    width: int
    height: int
    variant: str
    group: str
    precision: str
    threads: int
    truth: str
    """``no_cutoffs``: float64, nothing skipped, stopped or clamped. ``same_cutoffs``: float64 of the same variant."""
    forward: Spread
    backward: Spread
    repeats: int
    skipped: float | None
    """Share of the work that the switch leaves out when it is on, also in the row where it is off (`skipped_share`)."""
    memory: Memory
    error: Errors
    quality: Quality
    """Of the configuration in float32, as models are evaluated, whatever the precision of the row."""


def make_scenes(
    sizes: Sequence[tuple[int, int, int]], trained: Trained | None, seed: int
) -> dict[str, Workload]:
    """Workloads of these sizes, the first once more with one weight for both groups, and the first view of a trained scene."""
    scenes: dict[str, Workload] = {}
    for n, width, height in sizes:
        count = f"{n // 1000}k" if n >= 1000 else f"{n}"
        scenes[f"workload {count} {width}x{height}"] = make_workload(n, width, height, seed=seed)
    first = next(iter(scenes), None)
    if first is not None:
        scenes[f"{first}, one weight"] = with_one_weight(make_workload(*sizes[0], seed=seed))
    if trained is not None:
        views = trained.scene.test or trained.scene.train
        scenes[f"trained {trained.scene.name}"] = view_of(
            trained.module.model, views[0].camera, seed
        )
    return scenes


def run_error(
    scenes: Mapping[str, Workload],
    trained: Trained | None,
    threads: Sequence[int],
    repeats: int,
    out: Path,
    seed: int,
    stepping: Trained | None = None,
) -> list[Check]:
    """Measure every variant on every scene; write error.csv and error_checks.csv, and error_steps.csv for training.

    Args:
        scenes: What is rendered.
        trained: Whose scores are taken on scenes that are its own.
        threads: Of presets; switches are measured on the first.
        repeats: Times that each is timed.
        out: Folder of the files.
        seed: Of the workloads, for the record.
        stepping: Whose training steps are measured, with each switch of training on and off; None: no such file.

    Returns:
        The promises that were not kept.
    """
    header = provenance(
        seed,
        unit="milliseconds of wall clock (cpu: of all threads), MiB",
        upstream="standard normal over the number of pixels; workload: its own",
    )
    presets = raster_presets()
    checks = check_dense(presets, seed)
    rows: list[ErrorRow] = []
    for name, w in scenes.items():
        say(f"{name} ...")
        model = trained if name.startswith("trained") else None
        rows += _measure(name, w, presets, threads, repeats, model)
        checks += check_presets(name, w, presets) + check_rounding(name, w)
        for switch in raster_switches():
            checks += check_switch(name, w, switch)
    steps: list[StepRow] = []
    if stepping is not None:
        name, module = stepping.scene.name, stepping.module
        say(f"training steps on {name} ...")
        steps, kept = measure_switches(f"steps {name}", module, threads[0], repeats)
        checks += kept
        write_record(out / "error_steps.csv", steps, header)
    write_record(out / "error.csv", rows, header)
    write_record(out / "error_checks.csv", checks, header)
    _print(rows)
    _print_steps(steps)
    print_checks(checks)
    return violated(checks)


def _variants(presets: Mapping[str, RasterConfig], threads: Sequence[int]) -> list[Variant]:
    variants = [
        Variant(name, "preset", precision, count, config)
        for (name, config), precision, count in product(presets.items(), DTYPES, threads)
    ]
    for switch in raster_switches():
        label, config = switch.turned(presets["default"])
        variants.append(Variant(label, "switch", "float32", threads[0], config, switch))
    return variants


def _measure(
    name: str,
    w: Workload,
    presets: Mapping[str, RasterConfig],
    threads: Sequence[int],
    repeats: int,
    trained: Trained | None,
) -> Iterable[ErrorRow]:
    variants = _variants(presets, threads)
    copies = {precision: in_precision(w, dtype) for precision, dtype in DTYPES.items()}
    timed: dict[Variant, Callable[[], Pass]] = {
        v: partial(time_render, copies[v.precision], v.config, v.threads) for v in variants
    }
    samples = take_turns(timed, repeats)
    memory = _memories(copies, variants)
    truth: dict[RasterConfig, RasterOutcome] = {}
    qualities: dict[RasterConfig, Quality] = {}
    rows = []
    for v in variants:
        got = outcome(copies[v.precision], v.config)
        if v.config not in qualities:
            qualities[v.config] = measure_quality(trained, v.config, presets["exact"])
        forward, backward = spreads(samples[v])
        skipped = None if v.switch is None else skipped_share(w, v.switch)
        for label, config in (
            ("no_cutoffs", without_cutoffs(v.config)),
            ("same_cutoffs", v.config),
        ):
            if config not in truth:
                truth[config] = outcome(copies["float64"], config)
            c = w.camera
            rows.append(
                ErrorRow(
                    name, len(w.means), c.width, c.height, *v[:4], label, forward, backward,
                    repeats, skipped, memory[v], compare(got, truth[config]), qualities[v.config],
                )
            )  # fmt: skip
    return rows


def _memories(copies: Mapping[str, Workload], variants: Sequence[Variant]) -> dict[Variant, Memory]:
    """Each variant in a process of its own, which does nothing else."""
    memories: dict[Variant, Memory] = {}
    with tempfile.TemporaryDirectory() as folder:
        for precision, w in copies.items():
            save_workload(Path(folder) / f"{precision}.safetensors", w)
        for v in variants:
            path = Path(folder) / f"{v.precision}.safetensors"
            memories[v] = measure_memory(path, v.config, v.threads)
    return memories


def _print(rows: Sequence[ErrorRow]) -> None:
    for scene in dict.fromkeys(row.scene for row in rows):
        lines = []
        for r in (r for r in rows if r.scene == scene):
            if r.truth != "no_cutoffs":
                continue
            same = next(
                s for s in rows
                if s.truth == "same_cutoffs"
                and (s.scene, s.variant, s.precision, s.threads)
                == (r.scene, r.variant, r.precision, r.threads)
            )  # fmt: skip
            quality = [
                "" if value is None else f"{value:.{digits}f}"
                for value, digits in ((r.quality.psnr, 3), (r.quality.miou, 4))
            ]
            lines.append(
                (
                    r.variant, r.precision, f"{r.threads}", f"{r.forward.ms:.1f}", f"{r.backward.ms:.1f}",
                    f"{r.forward.cpu + r.backward.cpu:.1f}", f"{r.memory.extra_mib:.0f}",
                    f"{r.error.image_max:.1e}", f"{r.error.image_mean:.1e}", f"{r.error.gradient:.1e}",
                    f"{same.error.image_max:.1e}", f"{same.error.gradient:.1e}", _percent(r.skipped), *quality,
                )
            )  # fmt: skip
        columns = ("variant", "precision", "threads", "forward", "backward", "CPU", "+MiB")
        errors = ("max", "mean", "gradient", "max, same", "gradient, same")
        show(
            f"{scene}: ms (median wall; CPU of all threads), errors against float64 without cut-offs and with the same",
            (*columns, *errors, "skipped", "PSNR", "mIoU"),
            lines,
        )


def _print_steps(rows: Sequence[StepRow]) -> None:
    lines = []
    for r in rows:
        gradient = max((v for v in r.l2.values() if v is not None), default=0.0)
        cpu = [f"{a.cpu + b.cpu:.1f}" for a, b in ((r.on_forward, r.on_backward), (r.off_forward, r.off_backward))]  # fmt: skip
        times = [f"{t.ms:.1f}" for t in (r.on_forward, r.off_forward, r.on_backward, r.off_backward)]  # fmt: skip
        bound = "" if r.loss_bound is None else f"{r.loss_bound:.1e}"
        lines.append(
            (
                r.switch, r.kind, r.default, *times, *cpu, _percent(r.skipped),
                f"{r.loss_error:.1e}", bound, f"{r.loss:.2g}", f"{r.image_max:.1e}", f"{gradient:.1e}",
            )
        )  # fmt: skip
    if rows:
        columns = ("forward on", "off", "backward on", "off", "CPU on", "off", "skipped")
        errors = ("loss moves", "bound", "of", "max", "gradient")
        show(
            f"{rows[0].scene}, {rows[0].gaussians:,} Gaussians: ms per training step without Adam, the skip on and off",
            ("switch", "class", "default", *columns, *errors),
            lines,
        )


def _percent(share: float | None) -> str:
    return "" if share is None else f"{share:.1%}"


def print_checks(checks: Sequence[Check]) -> None:
    """Promise, figure, bound, and whether it holds."""
    show(
        "promises",
        ("scene", "promise", "measured", "bound", "holds"),
        [
            (c.scene, c.promise, f"{c.measured:.2e}", f"{c.bound:.2e}", "yes" if c.holds else "NO")
            for c in checks
        ],
    )
