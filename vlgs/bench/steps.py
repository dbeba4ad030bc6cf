"""Time and error of each skip of `vlgs.skips` that acts in a training step: one step with the skip, one without.

Both steps use the same module, parameters and views, and stop before Adam changes anything, so that they can be repeated. Some
skips act in some steps only: then those of such steps are timed in which most is lost.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch

from vlgs.bench.checks import Check, may_move
from vlgs.bench.clock import Spread, spreads, take_turns
from vlgs.bench.memory import MIB
from vlgs.bench.one_step import Step, StepSwitch, measure_step, run_steps, step_switches, turned
from vlgs.bench.outcome import Errors, compare
from vlgs.geometry import camera_center
from vlgs.objectives import BlendedView
from vlgs.objectives.between import BlendPlan
from vlgs.training.lightning import VLGSModule
from vlgs.types import Camera

STEPS = 4
"""Steps that are timed and compared, in turn; times are per step."""
DRAWS = 400
"""Iterations looked at for how often a blended view is left out."""


@dataclass(frozen=True)
class StepRow:
    """One line of error_steps.csv."""

    scene: str
    gaussians: int
    switch: str
    kind: str
    default: str
    """``on`` or ``off``: the skip's state where a run does not set its key."""
    threads: int
    steps: int
    """Number of steps that were timed."""
    on_forward: Spread
    on_backward: Spread
    """Includes the check that all gradients are finite."""
    off_forward: Spread
    off_backward: Spread
    repeats: int
    kept_mib: float | None
    """What is kept in memory instead, MiB; None where nothing is."""
    skipped: float | None
    """Share of the work that is left out, or of the blended views of `DRAWS` iterations; None where nothing counts it."""
    loss: float
    """With the work done, of the step in which it changes most (or comes nearest to its bound)."""
    loss_error: float
    """Its change."""
    loss_bound: float | None
    """What that may be, where the skip bounds it."""
    image_max: float
    """Largest change of a pixel of the two real views."""
    image_mean: float
    l2: Mapping[str, float | None]
    """|g - g_off| / |g_off| per parameter, the worst of the steps; None where it has no gradient."""
    cos: Mapping[str, float | None]


def measure_switches(
    scene: str, module: VLGSModule, threads: int, repeats: int, draws: int = DRAWS
) -> tuple[list[StepRow], list[Check]]:
    """Every switch on against off from the state that the module is in, and whether its promise holds.

    Args:
        scene: Name of the rows.
        module: A trained one, or on its way; it stays as it is.
        threads: For all of it.
        repeats: Times that the steps are timed.
        draws: Iterations in which blended views are counted.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        rows: list[StepRow] = []
        checks: list[Check] = []
        for switch in step_switches():
            pair = _Pair(module, switch, draws)
            sides = {on: partial(run_steps, pair.module(on), pair.steps) for on in (True, False)}
            samples = take_turns(sides, repeats, warm_up=0)
            times = (*spreads(samples[True]), *spreads(samples[False]))
            rows.append(pair.row(scene, threads, times, repeats))
            checks.append(pair.check(rows[-1]))
        return rows, checks
    finally:
        torch.set_num_threads(before)


class _Unlike(dict[tuple[int, int], float]):
    """SSIM(I1, I2) is 0, whatever the pair."""

    def __contains__(self, key: object) -> bool:
        return True

    def __getitem__(self, key: tuple[int, int]) -> float:
        return 0.0


class _Pair:
    """The two sides of a switch and the steps on which they are compared."""

    def __init__(self, module: VLGSModule, switch: StepSwitch, draws: int) -> None:
        self.switch = switch
        self.on, self.off = turned(module, switch, True), turned(module, switch, False)
        first = module.next_step
        self.steps: Sequence[int] = range(first, first + STEPS)
        self.skipped: float | None = None
        self.detour = 0.0
        if switch.field.startswith("blend"):
            self._look_for_effect(range(first, first + draws))
        for side in (self.on, self.off):  # what is kept from here on need not be made any more
            run_steps(side, self.steps)
            side.skips.restore({})

    def module(self, on: bool) -> VLGSModule:
        """One side."""
        return self.on if on else self.off

    def row(
        self, scene: str, threads: int, times: tuple[Spread, Spread, Spread, Spread], repeats: int
    ) -> StepRow:
        """What was timed and counted, and what is compared now."""
        skip = self.switch.skip
        if self.skipped is None and skip.name in (counted := self.on.skips.report()):
            self.skipped = counted[skip.name]["share"]
        sides = [(measure_step(self.on, s), measure_step(self.off, s)) for s in self.steps]
        errors = [compare(on.outcome, off.outcome) for on, off in sides]
        moved = [abs(on.loss - off.loss) for on, off in sides]
        bounds = [self._bound(off) for _, off in sides]
        # The step that is nearest to its bound, or beyond.
        worst = max(range(len(sides)), key=lambda i: moved[i] - (bounds[i] or 0.0))
        # Of the Gaussians and the fusion; the head is not trained here.
        names = [n for n, _ in self.off.model.named_parameters() if not n.startswith("head.")]
        return StepRow(
            scene, self.off.model.count, skip.name, skip.kind, skip.default, threads, len(sides),
            *times, repeats, self._kept_mib(), self.skipped, sides[worst][1].loss, moved[worst], bounds[worst],
            max(e.image_max for e in errors), max(e.image_mean for e in errors),
            {name: _worst(errors, "l2", name) for name in names},
            {name: _worst(errors, "cos", name) for name in names},
        )  # fmt: skip

    def check(self, row: StepRow) -> Check:
        """What the skip promises."""
        skip, scene = self.switch.skip, row.scene
        promise = f"{skip.name}: on against off"
        if skip.kind == "exact":
            moved = [v for v in row.l2.values() if v is not None]
            worst = max(row.loss_error / (abs(row.loss) or 1.0), row.image_max, *moved)
            return Check(scene, promise, worst, may_move(skip))
        if row.loss_bound is not None:
            # float32 rounds the sums of on and off apart.
            bound = row.loss_bound + 1e-6 * abs(row.loss)
            return Check(scene, f"{promise}, loss", row.loss_error, bound)
        assert isinstance(skip.on, float)
        # Cameras are float32.
        return Check(scene, f"{promise}, camera", self.detour, skip.on + 1e-5)

    def _kept_mib(self) -> float | None:
        return None if self.on.step.frozen is None else self.on.step.frozen.views.used / MIB

    def _bound(self, off: Step) -> float | None:
        """How far the loss may move."""
        if self.switch.skip.name != "blend_small":
            return None
        assert isinstance(self.switch.skip.on, float)
        return self.switch.skip.on * (off.blended or 0.0)

    def _look_for_effect(self, draws: Sequence[int]) -> None:
        """How often blended views are left out, the steps where most is lost by it, and how far the views that stand for them are off."""
        wanted: list[int] = []
        taken: dict[int, float] = {}
        for step in draws:
            on, off = _plan(self.on, step), _plan(self.off, step)
            if off is None or off.reuse is not None:
                continue
            wanted.append(step)
            if on is None:
                taken[step] = off.weight
            elif on.reuse is not None:
                cameras = [
                    self.on.views.scene.train[i].camera for i in self.on.views.sampler.pair(step)
                ]
                taken[step] = _detour(on.camera, off.camera, *cameras)
                self.detour = max(self.detour, taken[step])
        self.skipped = len(taken) / max(len(wanted), 1)
        if wanted and not taken and self.switch.skip.name == "blend_zero":
            # No two views of most scenes are so unlike each other: it is shown as if all were.
            self.on.views.similarities = self.off.views.similarities = _Unlike()
            taken = dict.fromkeys(wanted, 0.0)
        self.steps = sorted(taken, key=lambda s: -taken[s])[:STEPS] or self.steps


def _plan(module: VLGSModule, step: int) -> BlendPlan | None:
    first, second = module.views.sampler.pair(step)
    objective = module.step.setup.objectives["blended_view"]
    assert isinstance(objective, BlendedView)
    return objective.plan(step, (first, second), (module.views[first], module.views[second]))


def _detour(used: Camera, meant: Camera, first: Camera, second: Camera) -> float:
    """How far one camera is from another, in distance and in angle, as a share of what lies between two others."""
    apart = [_apart(used, meant), _apart(first, second)]
    return max(
        a / b if b else (0.0 if a == 0 else float("inf")) for a, b in zip(*apart, strict=True)
    )


def _apart(a: Camera, b: Camera) -> tuple[float, float]:
    """Distance of the centres, and the angle between the rotations in rad."""
    one, two = a.viewmat.double(), b.viewmat.double()
    distance = float((camera_center(one) - camera_center(two)).norm())
    # The chord, unlike the trace, is good to the last digits of a small angle.
    chord = float((one[:3, :3] - two[:3, :3]).norm()) / 8**0.5
    return distance, float(2 * torch.asin(torch.tensor(min(chord, 1.0), dtype=torch.float64)))


def _worst(errors: Sequence[Errors], kind: str, name: str) -> float | None:
    values = [getattr(e, kind)[name] for e in errors if name in getattr(e, kind)]
    return (max if kind == "l2" else min)(values) if values else None
