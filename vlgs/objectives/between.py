"""Whether an iteration needs its blended view, and where that looks from."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from vlgs.data.sampler import PairSampler
from vlgs.types import Camera
from vlgs.view_blend import ViewBlend, blend_cameras

AHEAD = 32
"""Iterations whose blended cameras are made together."""


@dataclass(frozen=True)
class BlendPlan:
    """The blended view of an iteration."""

    k: float
    similarity: float
    weight: float
    """lambda * SSIM(I1, I2) of Eq. 11."""
    camera: Camera
    reuse: int | None
    """Index (0 or 1) of the real view that is used in place of the blended one (`trainer.skip.blend_reuse`)."""


def plan_blend(
    cameras: tuple[Camera, Camera],
    k: float,
    between: Camera,
    similarity: float,
    weight: float,
    blend: ViewBlend,
    reuse_below: float,
) -> BlendPlan:
    """The blended camera `between`, or the real view that is near enough to stand for it.

    View 1 is at k = 1. What is at k = 0 is view 2 only if both rotation and translation are blended, and k means this only
    in the consistent convention, so that nothing is reused elsewhere.
    """
    reuse = None
    if blend.convention == "consistent":
        if abs(1 - k) < reuse_below:
            reuse = 0
        elif abs(k) < reuse_below and blend.rotation and blend.translation:
            reuse = 1
    camera = between if reuse is None else cameras[reuse]
    return BlendPlan(k, similarity, weight, camera, reuse)


@dataclass
class CamerasBetween:
    """Ratio and blended camera of every iteration: functions of the step alone, whatever was asked for before."""

    sampler: PairSampler
    cameras: Sequence[Camera]
    """Of the training views."""
    blend: ViewBlend
    _block: int = -1
    _made: dict[int, tuple[float, Camera]] = field(default_factory=dict)

    def at(self, step: int) -> tuple[float, Camera]:
        """The ratio k of an iteration, and the camera there."""
        if step // AHEAD != self._block:
            self._block = step // AHEAD
            self._made = self._make(range(self._block * AHEAD, (self._block + 1) * AHEAD))
        return self._made[step]

    def _make(self, steps: Sequence[int]) -> dict[int, tuple[float, Camera]]:
        pairs = [self.sampler.pair(step) for step in steps]
        firsts, seconds = ([self.cameras[pair[i]] for pair in pairs] for i in (0, 1))
        ks = [self.blend.draw(self.sampler.ratio_rng(step)) for step in steps]
        cameras = blend_cameras(firsts, seconds, ks, self.blend)
        return dict(zip(steps, zip(ks, cameras, strict=True), strict=True))
