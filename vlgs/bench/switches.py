"""The switches of `vlgs.skips` that a single render has: measured on against off."""

from dataclasses import dataclass, fields, replace

import torch

from vlgs.bench.checks import Check, check_bound, check_exact
from vlgs.bench.outcome import compare, largest_value, outcome
from vlgs.bench.workload import Workload
from vlgs.ops.project import project
from vlgs.ops.rasterize_to_pixels import RasterizeWork, count_work
from vlgs.skips import SKIPS, Skip
from vlgs.types import RasterConfig


@dataclass(frozen=True)
class RasterSwitch:
    """A skip whose setting is a field of `RasterConfig`."""

    skip: Skip
    field: str

    def on(self, config: RasterConfig) -> RasterConfig:
        """With the work left out."""
        return replace(config, **{self.field: self.skip.on})

    def off(self, config: RasterConfig) -> RasterConfig:
        """With the work done."""
        return replace(config, **{self.field: self.skip.off})

    def turned(self, default: RasterConfig) -> tuple[str, RasterConfig]:
        """The configuration that differs from the default by this switch, and its name."""
        off = self.off(default)
        if off != default:
            return f"{self.skip.name} off", off
        return f"{self.skip.name} on", self.on(default)


def raster_switches() -> list[RasterSwitch]:
    """In the order of `SKIPS`."""
    names = {field.name for field in fields(RasterConfig)}
    switches = []
    for skip in SKIPS:
        group, _, field = skip.setting.partition(".")
        if group == "raster" and field in names:
            switches.append(RasterSwitch(skip, field))
    return switches


def skipped_share(w: Workload, switch: RasterSwitch) -> float:
    """Share of the work that a switch leaves out of the forward pass when it is on, all others being as ``default`` has them.

    For ``tile_test`` work is entries of tile lists; for the others it is 4x4 blocks weighed, per Gaussian and chain.
    """
    default = RasterConfig()
    on, off = (_count(w, config) for config in (switch.on(default), switch.off(default)))
    kind = "entries" if switch.field == "tile_test" else "weighed"
    done, whole = getattr(on, kind), getattr(off, kind)
    return 1 - done / whole if whole else 0.0


def _count(w: Workload, config: RasterConfig) -> RasterizeWork:
    with torch.no_grad():
        splats = project(w.means, w.quats, w.scales, w.camera, config)
    return count_work(splats, w.groups, w.camera, config)


def check_switch(scene: str, w: Workload, switch: RasterSwitch) -> list[Check]:
    """On against off, in float32: an exact switch moves nothing, one with a bound no more than that."""
    default = RasterConfig()
    on, off = switch.on(default), switch.off(default)
    errors = compare(outcome(w, on), outcome(w, off))
    promise = f"{switch.skip.name}: on against off"
    if switch.skip.kind == "exact":
        return [check_exact(scene, promise, errors, switch.skip)]
    if switch.field == "transmittance_min":
        share = on.transmittance_min / (1 - on.alpha_max if on.stop == "before" else 1)
        # float32 rounds the sums of on and off alike, but not to the same bits.
        bound = share * largest_value(w) + 1e-6
        return [check_bound(scene, promise, errors, bound)]
    return []
