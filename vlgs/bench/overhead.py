"""What the Trainer, its callbacks and the progress bar add to an iteration."""

import tempfile
import time
from dataclasses import dataclass, fields
from pathlib import Path
from statistics import median

from hydra import compose, initialize_config_dir

from vlgs.config import CONF, instantiate
from vlgs.module.build import Parts, build_module
from vlgs.module.fit import FitOptions, fit
from vlgs.runs import RunFolder

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
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[*OVERRIDES, f"trainer.iterations={iterations}"])
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    module = build_module(instantiate(config.data), parts, config.seed)
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
