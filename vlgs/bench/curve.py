"""A learning curve: scores on held-out views after so many seconds of training, evaluation not counted."""

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lightning as L  # noqa: N812 (its own abbreviation)

from vlgs.bench.presets import Trained
from vlgs.bench.quality import score
from vlgs.fields.trained import SplatField
from vlgs.training.after_step import AfterStep, TrainedModule, own


@dataclass(frozen=True)
class CurvePoint:
    """Where a training stood."""

    scene: str
    label: str
    iteration: int
    seconds: float
    """Wall clock of the iterations, with densification and checkpoints, without evaluation and set-up."""
    cpu_seconds: float
    """The same, over all threads."""
    psnr: float | None
    """dB, mean over held-out views; None where there are none."""
    miou: float | None
    """Headline mIoU; None without language or vocabulary."""
    gaussians: int


class Curve(AfterStep):
    """Evaluates after chosen iterations. Must come last, so that what other callbacks do is counted.

    `meta` goes into every checkpoint, so that a training that was stopped goes on with its clocks and points. A checkpoint is
    written before its own iteration is counted and evaluated: what is missing of it then is evaluated when the training goes on.
    """

    def __init__(self, trained: Trained, scene: str, label: str, at: frozenset[int]) -> None:
        self.trained = trained
        self.scene = scene
        self.label = label
        self.at = at
        self.points: list[CurvePoint] = []
        self.wall = self.cpu = 0.0
        self.started = (0.0, 0.0)
        self.meta: dict[str, Any] = {"wall": 0.0, "cpu": 0.0, "points": []}

    def resume(self, meta: Mapping[str, Any]) -> None:
        """Go on from what a checkpoint says."""
        self.wall, self.cpu = meta["wall"], meta["cpu"]
        self.points = [CurvePoint(**point) for point in meta["points"]]
        self.meta.update(meta)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Evaluate what a stop came before."""
        self.evaluate(own(pl_module))

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Start the clocks."""
        self.started = (time.perf_counter(), time.process_time())

    def after_step(self, module: TrainedModule) -> None:
        """Stop the clocks, then evaluate if it is time."""
        self.wall += time.perf_counter() - self.started[0]
        self.cpu += time.process_time() - self.started[1]
        self.evaluate(module)
        points = [asdict(point) for point in self.points]
        self.meta.update(wall=self.wall, cpu=self.cpu, points=points)

    def evaluate(self, module: TrainedModule) -> None:
        """Add a point if this iteration has one and it is not there."""
        step = module.next_step
        if step not in self.at or (self.points and self.points[-1].iteration == step):
            return
        scores = score(
            self.trained.experiment, self.trained.scene, SplatField(self.trained.module.model)
        )
        self.points.append(
            CurvePoint(
                self.scene, self.label, step, self.wall, self.cpu,
                scores.psnr, scores.miou, module.count,
            )
        )  # fmt: skip


def evaluated_at(iterations: int, points: int) -> frozenset[int]:
    """Iterations of the evaluations, closer together at the start, where curves are steep; the last is among them.

    Example:
        >>> sorted(evaluated_at(1600, 4))
        [100, 400, 900, 1600]
    """
    return frozenset(max(1, round(iterations * (i / points) ** 2)) for i in range(1, points + 1))


def seconds_to(
    target: float | None, seconds: list[float], values: list[float | None]
) -> float | None:
    """When a curve first reaches a target, between its points by a straight line; None if it never does.

    Example:
        >>> seconds_to(25.0, [10.0, 20.0], [20.0, 30.0])
        15.0
    """
    known = [(s, v) for s, v in zip(seconds, values, strict=True) if v is not None]
    if target is None:
        return None
    for i, (s, v) in enumerate(known):
        if v >= target:
            if i == 0:
                return s
            before, low = known[i - 1]
            return before + (s - before) * (target - low) / (v - low)
    return None


def curve_path(folder: Path, scene: str, run: str) -> Path:
    """Where the curve of a run lies; the run id stands for all that can move a score."""
    name = "".join(c if c.isalnum() else "_" for c in scene)
    return folder / f"{name}-{run}.csv"
