"""One training step with a switch of `vlgs.skips` on or off. It ends before Adam, so that it can be repeated from the same state."""

from collections.abc import Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, fields, replace
from time import perf_counter, process_time
from typing import Any, NamedTuple

from vlgs.bench.clock import Pass
from vlgs.bench.outcome import RasterOutcome
from vlgs.fusion.none import NoFusion
from vlgs.skips import SKIPS, Skip
from vlgs.training.build import bind
from vlgs.training.lightning import VLGSModule
from vlgs.training.settings import SkipConfig
from vlgs.training.state import capture, restore
from vlgs.training.step import Forward

FROZEN = ("means", "quats", "log_scales", "sh0", "shN", "opacity_logits", "indicator_logits")
"""What is frozen on both sides of ``frozen_weights``: all but language."""


@dataclass(frozen=True)
class StepSwitch:
    """A skip whose setting is a field of `SkipConfig`."""

    skip: Skip
    field: str

    def setting(self, on: bool) -> dict[str, Any]:
        """The field and its value."""
        return {self.field: self.skip.on if on else self.skip.off}


class Step(NamedTuple):
    """What a step came to."""

    loss: float
    outcome: RasterOutcome
    """Images of the real views, gradients of all parameters."""
    blended: float | None
    """Mean squared error of the blended view; None where none was rendered or the view does not count."""


def step_switches() -> list[StepSwitch]:
    """In the order of `SKIPS`."""
    names = {field.name for field in fields(SkipConfig)}
    switches = []
    for skip in SKIPS:
        group, _, field = skip.setting.rpartition(".")
        if group == "trainer.skip" and field in names:
            switches.append(StepSwitch(skip, field))
    return switches


def turned(module: VLGSModule, switch: StepSwitch, on: bool) -> VLGSModule:
    """A module of its own in the same state, with the switch turned.

    ``frozen_weights`` is for language on finished geometry: on both sides everything else is frozen, and nothing fused.
    """
    freeze, config = module.settings.freeze, module.densifying.config
    if switch.field == "frozen_weights":
        own = [name for name in module.model.splats if name.startswith("language_")]
        freeze = [*FROZEN, *own]
        config = replace(config, densify=replace(config.densify, stop=0))
    skip = replace(module.settings.skip, **switch.setting(on))
    settings = replace(module.settings, freeze=freeze, skip=skip)
    model, given = deepcopy(module.model), module.step.setup
    objectives = {name: copy(objective) for name, objective in given.objectives.items()}
    setup = bind(objectives, given.views.scene, model, given.blend, skip, module.seed)
    setup.views.similarities = given.views.similarities  # constants of the scene
    made = VLGSModule(model, setup, config, settings, module.seed)
    restore(made, capture(module, {}))
    if switch.field == "frozen_weights":
        made.model.fusion = NoFusion()
    made.skips.restore({})
    return made


def run_step(module: VLGSModule, step: int) -> Pass:
    """One training step up to Adam, which does not follow: time forward, and backward until Adam would begin."""
    return _run(module, step)[0]


def _run(module: VLGSModule, step: int) -> tuple[Pass, Forward]:
    start = perf_counter(), process_time()
    module.set_schedule(step)
    done = module.step.forward(step)
    module.optimizer.zero_grad(set_to_none=True)
    middle = perf_counter(), process_time()
    module.step.backward(done)
    end = perf_counter(), process_time()
    ways = ((start, middle), (middle, end))
    return Pass(*(1e3 * (b - a) for way in ways for a, b in zip(*way, strict=True))), done


def run_steps(module: VLGSModule, steps: Sequence[int]) -> Pass:
    """Several steps from the one state; the mean of each time."""
    passes = [run_step(module, step) for step in steps]
    return Pass(*(sum(times) / len(passes) for times in zip(*passes, strict=True)))


def measure_step(module: VLGSModule, step: int) -> Step:
    """What the step comes to; its numbers are copies."""
    _, done = _run(module, step)
    renders = [render.detach() for render in done.seen.renders]
    images = [i for r in renders for i in (r.color, r.feature) if i is not None]
    gradients = {
        name: p.grad.double() for name, p in module.model.named_parameters() if p.grad is not None
    }
    outcome = RasterOutcome(tuple(image.double() for image in images), gradients)
    weight, blended = done.seen.log.get("blend_weight", 0.0), done.terms.get("blended")
    error = blended.item() / weight if blended is not None and weight > 0 else None
    return Step(float(done.total.detach()), outcome, error)
