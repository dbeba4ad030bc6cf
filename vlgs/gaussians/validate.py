"""Finds Gaussians whose parameters no renderer can use (not finite, too large, or a quaternion of zero), to refuse or to drop them."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from vlgs.gaussians.attributes import STANDARD

_LARGEST = 40.0
"""Logarithm of a scale whose square is far from overflowing float32."""


def broken_rows(params: Mapping[str, Tensor]) -> dict[str, Bool[Tensor, " n"]]:
    """What is wrong -> rows; only what occurs. Not finite, larger than float32 can hold, or a quaternion without a direction.

    Args:
        params: Raw parameters, of any attributes.
    """
    found = {}
    for name, value in params.items():
        broken = ~value.isfinite()
        found[f"{name} must be finite"] = (
            broken if value.dim() == 1 else broken.flatten(1).any(dim=1)
        )
    for name, value in params.items():
        if name in STANDARD and STANDARD[name].role == "rotation":
            found[f"{name} must not be zero"] = value.norm(dim=1) == 0
        if name in STANDARD and STANDARD[name].role == "scale":
            found[f"{name} must be at most {_LARGEST:g}"] = (value > _LARGEST).any(dim=1)
    return {what: rows for what, rows in found.items() if rows.any()}


def require_sound(who: str, params: Mapping[str, Tensor]) -> None:
    """Do nothing if every row can be rendered.

    Raises:
        ValueError: Names the parameter and how many rows.
    """
    for what, rows in broken_rows(params).items():
        tail = "that are" if "zero" in what else "that are not"
        raise ValueError(f"{who}: {what}, got {int(rows.sum())} of {len(rows)} rows {tail}")


def drop_broken(params: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, int]]:
    """The rows that are sound, in their order, and what was wrong with how many of the others."""
    found = broken_rows(params)
    if not found:
        return dict(params), {}
    kept = ~torch.stack(list(found.values())).any(dim=0)
    sound = {name: value[kept] for name, value in params.items()}
    return sound, {what: int(rows.sum()) for what, rows in found.items()}
