"""Gaussians and a camera to images."""

from vlgs.render.rasterize import rasterize

__all__ = ["rasterize"]
