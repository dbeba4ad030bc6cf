"""The truth of one held-out view, in the form that the protocols score against."""

from collections.abc import Sequence

from jaxtyping import UInt8
from torch import Tensor

from vlgs.metrics.masks import Unit
from vlgs.types import IGNORE_ID, View


def read_truth(view: View) -> UInt8[Tensor, "h w"] | None:
    """Dense class ids without the pixels that the photograph does not cover; None without dense labels."""
    if view.read_dense_labels is None:
        return None
    ids = view.read_dense_labels().ids
    if view.read_valid is not None:
        ids = ids.masked_fill(~view.read_valid(), IGNORE_ID)
    return ids


def read_units(
    view: View, classes: Sequence[str], truth: UInt8[Tensor, "h w"] | None
) -> list[Unit]:
    """Units of LERF-OVS: from object labels, otherwise one without boxes per class that the dense labels show.

    Raises:
        ValueError: If an object label names an unknown class.
    """
    if view.read_object_labels is not None:
        labels = view.read_object_labels()
        unknown = sorted(set(labels.masks) - set(classes))
        if unknown:
            raise ValueError(
                f"evaluate: labels of view {view.name!r} must be among the scene's classes, got {unknown}"
            )
        return [Unit(name, mask, labels.boxes.get(name)) for name, mask in labels.masks.items()]
    if truth is None:
        return []
    shown = (int(i) for i in truth.unique() if i != IGNORE_ID)
    return [Unit(classes[i], truth == i) for i in shown]
