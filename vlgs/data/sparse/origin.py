"""Models far from the origin, as georeferenced ones are: what float32 cannot tell apart there cannot be trained."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import TypeAlias

import torch

from vlgs.data.diagnostics import Fault, warning
from vlgs.data.sparse.model import SparseModel
from vlgs.geometry import camera_center, scene_extent

Origin: TypeAlias = tuple[float, float, float]

AT_HOME: Origin = (0.0, 0.0, 0.0)

FARTHEST = 20.0
"""Extents of the cameras. Farther from the origin the last steps of positions (1.6e-6 extents, as 3DGS has them) are less than half
of what float32 tells apart, and are lost."""


def origin_of(model: SparseModel) -> Origin:
    """Where the origin of a model should be: where it is, or amid cameras that are far from it.

    Args:
        model: Sound by `vlgs.data.sparse.model_faults`.

    Returns:
        World units; whole ones where cameras are that far apart.
    """
    viewmats = torch.stack([image.viewmat() for image in model.images])
    middle, extent = camera_center(viewmats).mean(dim=0), scene_extent(viewmats)
    if middle.norm() <= FARTHEST * extent:
        return AT_HOME
    decimals = max(0, -math.floor(math.log10(extent)))
    x, y, z = (round(value, decimals) for value in middle.tolist())
    return x, y, z


def moved(model: SparseModel, origin: Origin) -> SparseModel:
    """The same model in coordinates about another origin; in double precision, so that nothing is lost."""
    if origin == AT_HOME:
        return model
    shift = torch.tensor(origin, dtype=torch.float64)
    images = []
    for image in model.images:
        viewmat = image.viewmat()
        x, y, z = (viewmat[:3, 3] + viewmat[:3, :3] @ shift).tolist()
        images.append(replace(image, translation=(x, y, z)))
    return replace(model, images=tuple(images), points=model.points - shift.numpy())


def origin_warnings(model: SparseModel, origin: Origin) -> Iterator[Fault]:
    """That a scene is not in the coordinates of its model."""
    if origin == AT_HOME:
        return
    what = f"cameras should be within {FARTHEST:g} of their extents from the origin"
    advice = f"{subtracted(origin)}, and results are in what is left, where float32 is fine enough"
    yield warning(model.file("images"), f"{what}, got farther ones", advice)


def subtracted(origin: Origin) -> str:
    """What is told of positions about another origin.

    Example:
        >>> subtracted((500124.2, 5412345.3, 309.0))
        '(500124.2, 5412345.3, 309) is subtracted from all positions'
    """
    place = ", ".join(f"{value:.12g}" for value in origin)
    return f"({place}) is subtracted from all positions"
