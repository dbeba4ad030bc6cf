"""What the Trainer, its callbacks and the progress bar add to an iteration."""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from vlgs.bench.presets import build, composed
from vlgs.experiment import construct
from vlgs.runs import RunFolder
from vlgs.training.fit import FitOptions, fit

OVERRIDES = (
    "data.train_views=8",
    "data.test_views=2",
    "head.training.steps=20",
    "head.cache_dir=null",
    "gaussians.densify.stop=0",
    "trainer.checkpoint_every=0",
)


@dataclass(frozen=True)
class Overhead:
    """Milliseconds per iteration, medians over the iterations of one run."""

    step: float
    """`VLGSModule.training_step` itself."""
    around: float
    """From the end of one step to the start of the next: Lightning, callbacks, log.csv, progress bar."""


def measure_overhead(iterations: int) -> Overhead:
    """Train the default model for some iterations and time what lies between its steps."""
    experiment = construct(composed([*OVERRIDES, f"trainer.iterations={iterations}"]))
    module = build(experiment, experiment.read_scene())
    starts, ends = [], []
    step = module.training_step

    def timed(index: int, batch_idx: int) -> None:
        starts.append(time.perf_counter())
        step(index, batch_idx)
        ends.append(time.perf_counter())

    module.training_step = timed  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder:
        fit(module, RunFolder(Path(folder)), FitOptions(meta={}, progress=True))
    inside = [1e3 * (end - start) for start, end in zip(starts, ends, strict=True)]
    around = [1e3 * (start - end) for start, end in zip(starts[1:], ends[:-1], strict=True)]
    return Overhead(median(inside), median(around))
