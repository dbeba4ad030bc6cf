"""A field that answers some words by planes in the space of its embeddings, not by cosines with the words."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields import Field, FieldImages, HasGaussians, PointCloud, depth_of, faster
from vlgs.types import Camera, DepthKind


@dataclass(frozen=True)
class Plane:
    """What lies on the positive side of ``f weights + bias`` belongs to a word; f has unit length."""

    weights: Float[Tensor, " e"]
    bias: float


def with_planes(field: Field, words: Float[Tensor, "k e"], planes: Sequence[Plane]) -> Field:
    """The same scene, asked by planes.

    Args:
        field: What renders.
        words: Text vectors that have planes; all others are asked by their cosines.
        planes: One for each of them.
    """
    kind = PlaneGaussians if isinstance(field, HasGaussians) else PlaneField
    return kind(field, words, planes)


class PlaneField:
    """See `with_planes`."""

    def __init__(self, field: Field, words: Float[Tensor, "k e"], planes: Sequence[Plane]) -> None:
        self.field = field
        self.words = words
        self.planes = planes
        self.has_language = field.has_language

    @property
    def outputs(self) -> frozenset[str]:
        """See `Field`."""
        return self.field.outputs

    def levels(self) -> Sequence[Field]:
        """See `Field`; all have the same planes."""
        return self._each

    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        """See `Field`."""
        return self.field.render(camera, outputs)

    def similarity(
        self,
        camera: Camera,
        words: Float[Tensor, "k e"],
        seen: FieldImages | None = None,
        pixels: Int[Tensor, " p"] | None = None,
    ) -> Float[Tensor, "levels k h w"]:
        """See `Field`; the distance to the plane of a word, positive where it belongs to it."""
        asked, length, bias = self._asked(words)
        found = self.field.similarity(camera, asked, seen, pixels)
        return found * length[:, None, None] + bias[:, None, None]

    def depth(self, camera: Camera, kind: DepthKind = "expected") -> Float[Tensor, "h w"]:
        """See `HasDepth`."""
        return depth_of(self.field, camera, kind)

    def faster(self, within: float) -> Field:
        """See `HasFaster`; by rounding alone, as planes make more of an error."""
        return with_planes(faster(self.field), self.words, self.planes)

    def _asked(
        self, words: Float[Tensor, "k e"]
    ) -> tuple[Float[Tensor, "k e"], Float[Tensor, " k"], Float[Tensor, " k"]]:
        """What the field is asked in place of words, and how the cosines become distances."""
        asked, length, bias = words.clone(), torch.ones(len(words)), torch.zeros(len(words))
        for row, word in enumerate(words):
            for own, plane in zip(self.words, self.planes, strict=True):
                if torch.equal(own, word):
                    asked[row] = plane.weights
                    length[row], bias[row] = plane.weights.norm(), plane.bias
        return asked, length, bias

    @cached_property
    def _each(self) -> Sequence[Field]:
        inner = self.field.levels()
        if len(inner) == 1:
            return (self,)
        return [with_planes(level, self.words, self.planes) for level in inner]


class PlaneGaussians(PlaneField):
    """See `with_planes`; of Gaussians, which can be asked for themselves."""

    @property
    def _gaussians(self) -> HasGaussians:
        assert isinstance(self.field, HasGaussians)  # `with_planes`
        return self.field

    def opacities(self) -> Float[Tensor, " n"]:
        """See `HasGaussians`."""
        return self._gaussians.opacities()

    def language_weights(self) -> Float[Tensor, " n *levels"]:
        """See `HasGaussians`."""
        return self._gaussians.language_weights()

    def gaussian_similarity(self, words: Float[Tensor, "k e"]) -> Float[Tensor, "levels k n"]:
        """See `HasGaussians`; distances to planes, as `similarity`."""
        asked, length, bias = self._asked(words)
        found = self._gaussians.gaussian_similarity(asked)
        return found * length[:, None] + bias[:, None]

    def render_values(
        self, camera: Camera, values: Float[Tensor, "n c"], weight: Float[Tensor, " n"]
    ) -> Float[Tensor, "h w c"]:
        """See `HasGaussians`."""
        return self._gaussians.render_values(camera, values, weight)

    def point_cloud(self, cameras: Sequence[Camera]) -> PointCloud:
        """See `HasGaussians`."""
        return self._gaussians.point_cloud(cameras)
