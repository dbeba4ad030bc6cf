"""What the rasterizer promises, measured: each error beside the bound that it must keep."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch

from vlgs.bench.outcome import SMALLEST_ALPHA, Errors, compare, largest_value, outcome
from vlgs.bench.scenes import in_precision
from vlgs.bench.workload import Workload, make_workload
from vlgs.skips import Skip
from vlgs.types import RasterConfig

EXACT = 1e-6
"""Largest change by an exact switch that changes the order of sums: of image values absolute, of gradients relative."""
ROUNDING_IMAGE, ROUNDING_GRADIENT = 1e-5, 1e-3
"""float32 against float64 where nothing is cut off: image per largest value, gradients relative."""
DENSE = 1e-10
"""Kernel against the dense reference, both float64."""


@dataclass(frozen=True)
class Check:
    """One promise on one scene."""

    scene: str
    promise: str
    measured: float
    bound: float

    @property
    def holds(self) -> bool:
        """Whether it was kept; not a number is not."""
        return self.measured <= self.bound


def check_bound(scene: str, promise: str, errors: Errors, bound: float) -> Check:
    """A bound on what is skipped, as a share of the largest value of a group."""
    return Check(scene, promise, errors.image_max, bound)


def may_move(skip: Skip) -> float:
    """How much an exact switch may move: nothing where it promises the same bits."""
    return 0.0 if skip.bound == "same bits" else EXACT


def check_exact(scene: str, promise: str, errors: Errors, skip: Skip) -> Check:
    """A switch that must not move anything, images or gradients."""
    return Check(scene, promise, max(errors.image_max, errors.gradient), may_move(skip))


def check_presets(scene: str, w: Workload, presets: Mapping[str, RasterConfig]) -> list[Check]:
    """The error of each preset's early stop against the previous preset, which stops later, in float64: within the bound of its threshold."""
    true = in_precision(w, torch.float64)
    outcomes = {name: outcome(true, config) for name, config in presets.items()}
    checks = []
    for slow, fast in pairwise(presets):
        share = presets[fast].transmittance_min
        if presets[fast].stop == "before":
            share /= 1 - presets[fast].alpha_max
        errors = compare(outcomes[fast], outcomes[slow])
        # The image of float64 itself is good to some 1e-15 per Gaussian.
        bound = share * largest_value(w) + 1e-12
        checks.append(check_bound(scene, f"{fast} against {slow}: early stop", errors, bound))
    return checks


def check_rounding(scene: str, w: Workload) -> list[Check]:
    """float32 against float64 of the kernel, without the cut-offs at which rounding could add or drop a contribution."""
    config = RasterConfig(alpha_min=SMALLEST_ALPHA, transmittance_min=0.0)
    errors = compare(outcome(w, config), outcome(in_precision(w, torch.float64), config))
    relative = errors.image_max / max(largest_value(w), 1.0)
    return [
        Check(scene, "float32: image", relative, ROUNDING_IMAGE),
        Check(scene, "float32: gradients", errors.gradient, ROUNDING_GRADIENT),
    ]


def check_dense(presets: Mapping[str, RasterConfig], seed: int) -> list[Check]:
    """The kernel against the dense reference, which shares no code with it, on a scene that the reference can do."""
    w = in_precision(make_workload(400, 64, 48, seed=seed), torch.float64)
    checks = []
    for name, config in presets.items():
        errors = compare(outcome(w, config), outcome(w, config, "reference"))
        worst = max(errors.image_max, errors.gradient)
        checks.append(Check("400 Gaussians, 64x48", f"{name}: kernel = reference", worst, DENSE))
    return checks


def violated(checks: Sequence[Check]) -> list[Check]:
    """The promises that were not kept."""
    return [check for check in checks if not check.holds]
