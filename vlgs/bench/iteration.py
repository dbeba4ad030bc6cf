"""Where the CPU time of a training iteration goes, by part, at two sizes."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from inspect import getattr_static
from statistics import fmean
from typing import Any

import torch
from rich.table import Table

from vlgs.bench.clock import replaced
from vlgs.bench.presets import build, composed
from vlgs.experiment import construct
from vlgs.objectives import BlendedView
from vlgs.ops import attention, project, rasterize_to_pixels, view_color
from vlgs.training.lightning import VLGSModule

KERNELS = ("project", "blend", "fusion", "Adam")
"""Parts that are not overhead: everything else is called the rest."""

OVERRIDES = (
    "data.test_views=2",
    "head.training.steps=20",
    "head.cache_dir=null",
    "gaussians.densify.stop=0",
    # The paper's step: `vlgs.bench.seams` writes it out, and times stay comparable with those of before language and blur were ours.
    "raster.eps2d=0.3",
    "raster.near_sigmas=0",
    "trainer.indicator_reach=0.0",
    "trainer.language_weight=1.0",
    "trainer.language_error=mse",
    "trainer.language_support=0.0",
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


class Stopwatch:
    """CPU seconds of all threads per part; what a part calls counts for the inner one only."""

    def __init__(self) -> None:
        self.parts: dict[str, float] = defaultdict(float)
        self._open: list[str] = []
        self._since = 0.0

    def around(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The call, timed."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._book()
            self._open.append(part)
            try:
                return call(*args, **kwargs)
            finally:
                self._book()
                self._open.pop()

        return timed

    def _book(self) -> None:
        now = time.process_time()
        if self._open:
            self.parts[self._open[-1]] += now - self._since
        self._since = now


def measure_iteration(size: IterationSize, iterations: int) -> dict[str, float]:
    """Mean CPU milliseconds of every part of an iteration, after three that are not counted.

    An iteration is `VLGSModule.training_step` and the statistics of densification. Keys are `KERNELS`, the parts of the
    rest, and ``total``.
    """
    watch = Stopwatch()
    rows: list[dict[str, float]] = []
    with ExitStack() as patches:
        module = make_module(size)
        for index in range(size.views):
            module.views[index]  # as after the first epoch
        for owner, name, part in _timed(module):
            call = watch.around(part, getattr(owner, name))
            static = isinstance(getattr_static(owner, name), staticmethod)
            patches.enter_context(replaced(owner, name, staticmethod(call) if static else call))
        first = size.sh_degree * module.settings.sh_every
        statistics = watch.around("densification statistics", _gather_statistics)
        step = watch.around("step, what is left", module.training_step)
        for index in range(first, first + iterations + 3):
            watch.parts.clear()
            step(index, index)
            statistics(module)
            rows.append({**watch.parts, "total": sum(watch.parts.values())})
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: 1e3 * fmean(row.get(name, 0.0) for row in rows[3:]) for name in names}


def _timed(module: VLGSModule) -> Iterator[tuple[Any, str, str]]:
    """What is timed, and as which part."""
    functions = {
        "project": project._Project,
        "blend": rasterize_to_pixels._RasterizeToPixels,
        "fusion": attention._Attention,
        "spherical harmonics": view_color._ViewColor,
    }
    for part, function in functions.items():
        yield function, "forward", part
        yield function, "backward", part
    yield module.optimizer, "step", "Adam"
    yield module.optimizer, "zero_grad", "zero_grad"
    yield type(module.views), "__getitem__", "targets"
    yield module.views, "similarity", "similarity of the views"
    yield module.step, "backward", "backward of the rest"
    yield module, "_refuse_non_finite", "finite check"
    for objective in module.step.setup.objectives.values():
        blended = isinstance(objective, BlendedView)
        part = "blended view, forward" if blended else "losses, forward"
        yield type(objective), "__call__", part
    yield module.model, "fuse", "activation, forward"
    yield module.model, "view_color", "spherical harmonics"
    yield module.model, "render", "render, what is left"


def _gather_statistics(module: VLGSModule) -> None:
    report = module.report
    for gradient, render in zip(report.screen_gradients, report.renders, strict=True):
        height, width = render.alpha_color.shape if render.alpha_color is not None else (1, 1)
        module.densifying.state.accumulate(gradient, render.visible, width, height)


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


def make_module(size: IterationSize) -> VLGSModule:
    """What a run of this size trains, at its start."""
    overrides = [
        *OVERRIDES,
        f"data.train_views={size.views}",
        f"data.width={size.width}",
        f"data.height={size.height}",
        f"data.points={size.gaussians}",
    ]
    experiment = construct(composed(overrides))
    return build(experiment, experiment.read_scene())
