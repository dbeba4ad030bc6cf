"""Where the CPU time of a training iteration goes, by part, at two sizes."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from statistics import median
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from rich.table import Table

from vlgs.config import CONF, instantiate
from vlgs.module.build import Parts, build_module
from vlgs.module.lightning import VLGSModule

KERNELS = ("project", "blend", "fusion", "Adam")
"""Parts that are not overhead: everything else is called the rest."""

OVERRIDES = (
    "data.test_views=2",
    "codec.training.steps=20",
    "codec.cache_dir=null",
    "gaussians.densify.stop=0",
)


@dataclass(frozen=True)
class IterationSize:
    """One row of the table: a default run that differs in these values."""

    gaussians: int
    width: int
    height: int
    views: int
    sh_degree: int


SIZES = (IterationSize(5_000, 200, 150, 40, 0), IterationSize(100_000, 986, 728, 4, 3))


@dataclass
class Stopwatch:
    """CPU seconds of all threads, per part, of the iteration under way."""

    parts: dict[str, float] = field(default_factory=lambda: defaultdict(float))

    def around(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The call, timed."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.process_time()
            try:
                return call(*args, **kwargs)
            finally:
                self.parts[part] += time.process_time() - start

        return timed


def measure_iteration(size: IterationSize, iterations: int) -> dict[str, float]:
    """Median CPU milliseconds of every part of an iteration, after three that are not counted.

    Keys are `KERNELS`, parts of the rest that were timed, and ``total``.
    """
    watch = Stopwatch()
    rows: list[dict[str, float]] = []
    with _timed_kernels(watch):
        module = _module(size)
        module.optimizer.step = watch.around("Adam", module.optimizer.step)
        module.optimizer.zero_grad = watch.around("zero_grad", module.optimizer.zero_grad)
        module.target = watch.around("targets", module.target)
        for step in range(iterations + 3):
            watch.parts.clear()
            start = time.process_time()
            module.training_step(step + size.sh_degree * module.settings.sh_every, step)
            rows.append({**watch.parts, "total": time.process_time() - start})
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: 1e3 * median(row.get(name, 0.0) for row in rows[3:]) for name in names}


def share_of_rest(parts: dict[str, float]) -> float:
    """Share of an iteration that lies outside `KERNELS`."""
    return 1 - sum(parts.get(name, 0.0) for name in KERNELS) / parts["total"]


def show_iterations(measured: list[tuple[IterationSize, dict[str, float]]]) -> Table:
    """One column per size: milliseconds and share of every part."""
    table = Table(title=f"CPU time of a training iteration, {torch.get_num_threads()} threads")
    table.add_column("part")
    for size, _ in measured:
        name = f"{size.gaussians} at {size.width}x{size.height}, SH {size.sh_degree}"
        table.add_column(name, justify="right")
    names = dict.fromkeys([*KERNELS, *(name for _, parts in measured for name in parts)])
    for name in names:
        if name != "total":
            shown = [
                f"{parts.get(name, 0.0):.2f} ms {parts.get(name, 0.0) / parts['total']:6.1%}"
                for _, parts in measured
            ]
            table.add_row(name, *shown)
    rest = [f"{share_of_rest(p) * p['total']:.2f} ms {share_of_rest(p):6.1%}" for _, p in measured]
    table.add_section()
    table.add_row("outside " + ", ".join(KERNELS), *rest)
    table.add_row("whole iteration", *(f"{parts['total']:.2f} ms 100.0%" for _, parts in measured))
    return table


def _module(size: IterationSize) -> VLGSModule:
    overrides = [
        *OVERRIDES,
        f"data.train_views={size.views}",
        f"data.width={size.width}",
        f"data.height={size.height}",
        f"gaussians.init_points={size.gaussians}",
    ]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=overrides)
    parts = Parts(**{part.name: instantiate(config[part.name]) for part in fields(Parts)})
    return build_module(instantiate(config.data), parts, config.seed)


@contextmanager
def _timed_kernels(watch: Stopwatch) -> Iterator[None]:
    """Time every call into the compiled kernels while this lasts."""
    raise NotImplementedError
