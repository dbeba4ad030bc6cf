"""Gaussians and a camera to images."""

from vlgs.ops.rasterize import rasterize

__all__ = ["rasterize"]
