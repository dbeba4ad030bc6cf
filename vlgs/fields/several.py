"""Fields of one scene, each of other mask levels, as one field."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields import Field, FieldImages, depth_of, faster, require_outputs
from vlgs.types import Camera, DepthKind


class SeveralFields:
    """One field per mask level (``levels=separate``), of which the first gives the colour.

    Args:
        fields: At least one, the finest level first.

    Raises:
        ValueError: If there is none.
    """

    def __init__(self, fields: Sequence[Field]) -> None:
        if not fields:
            raise ValueError("several fields: there must be at least one field, got none")
        self.fields = fields

    @property
    def outputs(self) -> frozenset[str]:
        """See `Field`: those of the first, but language only if all have it."""
        first, *others = (field.outputs for field in self.fields)
        return first - {"feature"} if any("feature" not in other for other in others) else first

    @property
    def has_language(self) -> bool:
        """See `Field`."""
        return all(field.has_language for field in self.fields)

    def levels(self) -> Sequence[Field]:
        """See `Field`."""
        return [level for field in self.fields for level in field.levels()]

    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        """See `Field`: one pass for each level if language is asked for."""
        require_outputs("several fields", outputs, self.outputs)
        first = self.fields[0].render(camera, outputs)
        if first.feature is None:
            return first
        features = [first.feature]
        for field in self.fields[1:]:
            feature = field.render(camera, frozenset({"feature"})).feature
            assert feature is not None  # it was asked for
            features.append(feature)
        return FieldImages(first.color, first.alpha, torch.cat(features))

    def similarity(
        self,
        camera: Camera,
        words: Float[Tensor, "k e"],
        seen: FieldImages | None = None,
        pixels: Int[Tensor, " p"] | None = None,
    ) -> Float[Tensor, "levels k h w"]:
        """See `Field`."""
        counts = [len(field.levels()) for field in self.fields]
        parts: Sequence[FieldImages | None] = [None] * len(counts)
        if seen is not None and seen.feature is not None:
            parts = [FieldImages(feature=part) for part in seen.feature.split(counts)]
        found = [
            field.similarity(camera, words, part, pixels)
            for field, part in zip(self.fields, parts, strict=True)
        ]
        return torch.cat(found)

    def depth(self, camera: Camera, kind: DepthKind = "expected") -> Float[Tensor, "h w"]:
        """See `HasDepth`: that of the first, as colour is."""
        return depth_of(self.fields[0], camera, kind)

    def faster(self, within: float) -> "SeveralFields":
        """See `HasFaster`."""
        return SeveralFields([faster(field, within) for field in self.fields])
