"""gsplat's names over the kernel of vlgs, for scripts that are written for gsplat and a machine without CUDA.

    from vlgs.gsplat import rasterization  # in place of: from gsplat import rasterization

`rasterization` follows gsplat 1.5.3; its docstring says what differs. Everything else of gsplat that runs without CUDA is used as it is,
its `DefaultStrategy` above all: ``pip install gsplat==1.5.3``. ``python -m vlgs.gsplat.example`` trains a scene so.
"""

from vlgs.gsplat.rendering import rasterization

__all__ = ["rasterization"]
