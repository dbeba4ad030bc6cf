"""Experiments in 3D vision-language Gaussian splatting.

The public functions are loaded on first use, so that `import vlgs` costs nothing and entry points that need no tensors
never import torch.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vlgs.ops.depth import render_depth as render_depth
    from vlgs.ops.rasterize import rasterize as rasterize
    from vlgs.types import Camera as Camera
    from vlgs.types import ChannelGroup as ChannelGroup
    from vlgs.types import RasterConfig as RasterConfig
    from vlgs.types import Rendered as Rendered
    from vlgs.types import Scene as Scene

__version__ = "0.1.0"

# PyTorch's threads that spin at a barrier while another process has the second core made a training step 50 times slower here
# (768 ms against 15 ms). Read by libgomp when torch loads it; whoever set it keeps it. The kernel's threads are its own.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_HOME = {
    "rasterize": "vlgs.ops.rasterize",
    "render_depth": "vlgs.ops.depth",
    "Camera": "vlgs.types",
    "ChannelGroup": "vlgs.types",
    "RasterConfig": "vlgs.types",
    "Rendered": "vlgs.types",
    "Scene": "vlgs.types",
}

__all__ = [
    "Camera", "ChannelGroup", "RasterConfig", "Rendered", "Scene", "rasterize", "render_depth",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'vlgs' has no attribute {name!r}")
