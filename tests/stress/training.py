"""Training under attack: poisoned gradients, hostile learning rates, weights at the ends of their range (N1, N11)."""

import logging
import math
import re
import tempfile
from collections.abc import Callable
from dataclasses import fields
from functools import cache
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir

from tests.stress.case import Case, Verdict
from tests.stress.splats import make_splats
from vlgs.config import CONF, instantiate
from vlgs.data.synthetic import load_scene
from vlgs.gaussians.logistic import logit
from vlgs.gaussians.parameters import activate
from vlgs.ops.rasterize import rasterize
from vlgs.runs import RunFolder
from vlgs.training import zero_gradients
from vlgs.training.build import Parts, build_module
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.types import ChannelGroup, Scene

TINY = ("head.training.steps=8", "head.cache_dir=null", "trainer=smoke")
RATES = ("means", "quats", "log_scales", "sh0", "shN", "opacity_logits", "indicator_logits",
         "features", "fusion")  # fmt: skip


@cache
def scene() -> Scene:
    """A procedural scene of six small views."""
    return load_scene(width=48, height=36, train_views=6, test_views=1, points=400)


@cache
def wide_scene() -> Scene:
    """One with work for several threads: more Gaussians than `kWorthThreads` (csrc/threads.h), more pixels than torch gives to one."""
    return load_scene(width=128, height=96, train_views=3, test_views=1, points=5000)


def make_module(*overrides: str, wide: bool = False) -> VLGSModule:
    """The default method on the tiny scene, or on the wide one."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[*TINY, *overrides])
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(wide_scene() if wide else scene(), parts, config.seed)


def train(module: VLGSModule, folder: Path) -> None:
    """To the end of its budget, in a folder of its own."""
    fit(module, RunFolder(folder), FitOptions(meta={}, progress=False))


def before_steps(module: VLGSModule, act: Callable[[int], None]) -> None:
    """Call `act` with the number of every step before it is taken."""
    step = module.training_step

    def training_step(index: int, batch_idx: int) -> None:
        act(index)
        step(index, batch_idx)

    module.training_step = training_step  # type: ignore[method-assign]


def poisoned_gradients(full: bool) -> Verdict:
    """NaN or Inf in one row of any gradient, or of any parameter: the error names tensor, row and views in that step, and the checkpoint before it is whole."""
    names = list(make_module().model.splats) if full else ["shN", "log_scales"]
    # A weight of the fusion that is not finite poisons every row: there is no row to name.
    tries = [("gradient", name) for name in (*names, "fusion")] + [("parameter", n) for n in names]
    values = (math.nan, math.inf, -math.inf) if full else (math.nan,)
    wrong = []
    for where, name in tries:
        for value in values:
            if message := _poison(name, value, where):
                wrong.append(f"{where} of {name} = {value}: {message}")
    tried = len(tries) * len(values)
    return Verdict(f"{tried} poisonings, wrong: {'; '.join(wrong) or 'none'}", not wrong)


def _poison(name: str, value: float, where: str) -> str:
    """Train past a checkpoint, poison row 5 before step 7; returns what is wrong with the answer."""
    module = make_module("trainer.iterations=10", "trainer.checkpoint_every=4", "trainer.sh_every=1",
                         "gaussians.densify.stop=0")  # fmt: skip

    def act(step: int) -> None:
        if step != 7:
            return
        tensor = (
            next(module.model.fusion.parameters())  # pyright: ignore
            if name == "fusion"
            else module.model.splats[name]
        )
        if where == "parameter":
            with torch.no_grad():
                tensor[5] = value
        else:
            tensor.register_hook(lambda g: g.index_fill(0, torch.tensor([5]), value))

    before_steps(module, act)
    with tempfile.TemporaryDirectory() as folder:
        try:
            train(module, Path(folder))
        except (FloatingPointError, ValueError) as error:
            message = str(error)
        else:
            return "nothing was said"
        checkpoint = load_checkpoint(Path(folder) / "checkpoint")
    if checkpoint is None or checkpoint.step != 4:
        return "no checkpoint of step 4"
    if not all(
        t.isfinite().all() for k, t in checkpoint.tensors.items() if k.startswith("model.splats")
    ):
        return "the checkpoint is not finite"
    return "" if is_located(message) and "row 5" in message and "step 7" in message else message


def is_located(message: str) -> bool:
    """Whether a message names a tensor, its row, the step and the views."""
    return (
        re.search(r"must be .*got .* row \d+.* in step \d+ with views \w+ and \w+", message)
        is not None
    )


def hostile_training(full: bool) -> Verdict:
    """Learning rates times ten while indicators, then opacities, are pushed to 0 and to 1: parameters stay finite, or a located error."""
    iterations = 2000 if full else 150
    base = make_module().settings.learning_rates
    rates = [
        f"trainer.learning_rates.{name}={10 * getattr(base, name)}"
        for name in (*RATES, "means_final")
    ]
    module = make_module(
        f"trainer.iterations={iterations}", f"trainer.sh_every={iterations // 6}",
        f"gaussians.densify={{start: 20, stop: {iterations}, every: 25, reset_every: {iterations // 3}}}",
        "trainer.checkpoint_every=0", *rates,
    )  # fmt: skip
    part, counts = iterations // 5, []

    def push(step: int) -> None:
        counts.append(module.model.count)
        if step % 10:
            return
        name = "indicator_logits" if step // part % 2 == 0 else "opacity_logits"
        end = 40.0 if step // (2 * part) % 2 else -40.0
        with torch.no_grad():
            module.model.splats[name][step // 10 % 2 :: 2] += end

    before_steps(module, push)
    with tempfile.TemporaryDirectory() as folder:
        try:
            train(module, Path(folder))
        except (FloatingPointError, ValueError) as error:
            return Verdict(f"stopped at step {module.next_step}: {error}", is_located(str(error)))
    finite = all(p.isfinite().all() for p in module.model.parameters())
    return Verdict(
        f"{module.next_step} iterations, {min(counts)} to {max(counts)} Gaussians, loss {module.report.loss:.3g}",
        finite and module.next_step == iterations,
    )


def stuck_weights(full: bool) -> Verdict:
    """O = l at logits of 14 to 20 (1 - 1e-6 and beyond) with a target that needs 0 come down in 800 steps; at 1e-3, below the cutoff, the alarm says that nothing moves."""
    steps = {start: _steps_down(start) for start in (logit(1 - 1e-6), 17.5, 20.0)}
    module = make_module(
        "gaussians.init_opacity=0.001", "gaussians.init_indicator=0.001", "gaussians.densify.stop=0",
        "trainer.iterations=8", "trainer.log_every=2", "trainer.checkpoint_every=0",
    )  # fmt: skip
    flagged = _alarms(module)
    healthy = make_module("trainer.iterations=60" if full else "trainer.iterations=12",
                          "gaussians.densify.stop=0", "trainer.log_every=2")  # fmt: skip
    false_alarms = _alarms(healthy)
    passed = max(steps.values()) <= 800 and len(flagged) == 2 and not false_alarms
    downs = ", ".join(f"{start:.1f} in {count}" for start, count in steps.items())
    return Verdict(
        f"down from {downs}; alarms at 1e-3: {len(flagged)} of 2; in a healthy run: {len(false_alarms)}",
        passed,
    )


def _steps_down(start: float, most: int = 2000) -> int:
    """Adam steps until every weight of a bright row of Gaussians before a black target is below 0.1."""
    splats = make_splats(12, size=(48, 36), channels=(3, 3))
    logits = torch.full((2, 12), start, requires_grad=True)
    values = [torch.ones(12, 3), torch.ones(12, 3)]
    parameters = {
        "means": splats.means, "quats": splats.quats, "log_scales": splats.scales.log(),
        "sh0": values[0], "shN": torch.zeros(12, 0, 3), "features": values[1],
    }  # fmt: skip
    optimizer = torch.optim.Adam([logits], lr=0.05, eps=1e-15)
    for step in range(1, most + 1):
        active = activate(parameters | {"opacity_logits": logits[0], "indicator_logits": logits[1]})
        out = rasterize(
            splats.means, splats.quats, splats.scales,
            [ChannelGroup(values[0], active.opacities), ChannelGroup(values[1], active.indicators)],
            torch.eye(4), torch.tensor([[43.0, 0, 24], [0, 43, 18], [0, 0, 1]]), 48, 36,
        )  # fmt: skip
        optimizer.zero_grad()
        sum(image.square().mean() for image in out.images).backward()  # pyright: ignore
        optimizer.step()
        if logits.max() < logit(0.1):
            return step
    return most + 1


def _alarms(module: VLGSModule) -> set[str]:
    """Weights that the alarm of a training run named."""
    found: list[str] = []

    class Catch(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found.append(str(record.args[0]) if isinstance(record.args, tuple) else "")

    handler = Catch()
    zero_gradients.log.addHandler(handler)
    try:
        with tempfile.TemporaryDirectory() as folder:
            train(module, Path(folder))
    finally:
        zero_gradients.log.removeHandler(handler)
    return set(found)


TRAINING = (
    Case("N1 poisoned gradients", poisoned_gradients),
    Case("N1 hostile training", hostile_training),
    Case("N11 stuck weights", stuck_weights),
)
