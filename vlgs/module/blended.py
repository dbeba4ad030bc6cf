"""Whether an iteration needs its blended view, and where that looks from."""

from dataclasses import dataclass

from vlgs.blend import ViewBlend, blend_camera
from vlgs.types import Camera


@dataclass(frozen=True)
class BlendPlan:
    """The blended view of an iteration."""

    k: float
    similarity: float
    weight: float
    """lambda * SSIM(I1, I2) of Eq. blend."""
    camera: Camera
    reuse: int | None
    """0 or 1 where that real view's language stands for the blended view's (`trainer.skip.blend_reuse`)."""


def plan_blend(
    cameras: tuple[Camera, Camera],
    k: float,
    similarity: float,
    weight: float,
    blend: ViewBlend,
    reuse_below: float,
) -> BlendPlan:
    """The blended camera, or the real view that is near enough to stand for it.

    View 1 is at k = 1. What is at k = 0 is view 2 only if both rotation and translation are blended, and k means this only
    in the consistent convention, so that nothing is reused elsewhere.
    """
    reuse = None
    if blend.convention == "consistent":
        if abs(1 - k) < reuse_below:
            reuse = 0
        elif abs(k) < reuse_below and blend.rotation and blend.translation:
            reuse = 1
    camera = blend_camera(*cameras, k, blend) if reuse is None else cameras[reuse]
    return BlendPlan(k, similarity, weight, camera, reuse)
