"""Camera-view blending: a third camera between two real ones, and the language map it should see (Eqs. 9 to 11)."""

from vlgs.view_blend.pose import blend_camera, blend_cameras, slerp
from vlgs.view_blend.ratio import (
    BetaBlend,
    FixedBlend,
    GaussianBlend,
    NoBlend,
    UniformBlend,
    ViewBlend,
)
from vlgs.view_blend.target import blend_targets

__all__ = [
    "BetaBlend",
    "FixedBlend",
    "GaussianBlend",
    "NoBlend",
    "UniformBlend",
    "ViewBlend",
    "blend_camera",
    "blend_cameras",
    "blend_targets",
    "slerp",
]
