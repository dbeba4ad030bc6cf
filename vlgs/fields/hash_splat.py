"""Gaussians whose language is a function of where they are: a language field is asked at their means (FMGS)."""

from collections.abc import Sequence
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields import Field, FieldImages, PointCloud, require_outputs
from vlgs.fields.language_field import LanguageField
from vlgs.fields.radiance import Frame, in_cube
from vlgs.fields.similarity import CHUNK, cosines, rendered_feature
from vlgs.fields.trained import SplatField
from vlgs.types import Camera, DepthKind


class HashSplatField:
    """Trained Gaussians and a language field, whose embeddings are blended with the weights of colour.

    Args:
        splats: Draws colour.
        language: Says what a place means.
        frame: What lies in the unit ball, whose surroundings are contracted.
    """

    outputs = frozenset({"color", "alpha", "feature"})
    has_language = True

    def __init__(self, splats: SplatField, language: LanguageField, frame: Frame) -> None:
        self.splats = splats
        self.language = language
        self.frame = frame

    def levels(self) -> Sequence[Field]:
        """See `Field`; there is one."""
        return (self,)

    @torch.no_grad()
    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        """See `Field`; `feature` is the blended embedding, not of unit length."""
        require_outputs("hash splat field", outputs, self.outputs)
        rest = outputs - {"feature"}
        seen = self.splats.render(camera, rest) if rest else FieldImages()
        feature = None
        if "feature" in outputs:
            feature = self.render_values(camera, self.embeddings, self.opacities())[None]
        return FieldImages(seen.color, seen.alpha, feature)

    @torch.no_grad()
    def similarity(
        self,
        camera: Camera,
        words: Float[Tensor, "k e"],
        seen: FieldImages | None = None,
        pixels: Int[Tensor, " p"] | None = None,
    ) -> Float[Tensor, "levels k h w"]:
        """See `Field`."""
        return cosines(rendered_feature(self, camera, seen, pixels)[0], words)[None]

    def opacities(self) -> Float[Tensor, " n"]:
        """See `HasGaussians`."""
        return self.splats.opacities()

    def language_weights(self) -> Float[Tensor, " n *levels"]:
        """See `HasGaussians`: language is blended as colour is."""
        return self.splats.opacities()

    @torch.no_grad()
    def gaussian_similarity(self, words: Float[Tensor, "k e"]) -> Float[Tensor, "levels k n"]:
        """See `HasGaussians`."""
        return cosines(self.embeddings, words)[None]

    def render_values(
        self, camera: Camera, values: Float[Tensor, "n c"], weight: Float[Tensor, " n"]
    ) -> Float[Tensor, "h w c"]:
        """See `HasGaussians`."""
        return self.splats.render_values(camera, values, weight)

    def depth(self, camera: Camera, kind: DepthKind = "expected") -> Float[Tensor, "h w"]:
        """See `HasDepth`."""
        return self.splats.depth(camera, kind)

    def point_cloud(self, cameras: Sequence[Camera]) -> PointCloud:
        """See `HasGaussians`; language is no part of it, since no code of a Gaussian says it."""
        return self.splats.point_cloud(cameras)

    @cached_property
    def embeddings(self) -> Float[Tensor, "n e"]:
        """What each Gaussian says, at unit length; known once training is over."""
        with torch.no_grad():
            places = in_cube(
                (self.splats.model.splats["means"] - self.frame.center) * self.frame.scale
            )
            parts = [self.language.embed(self.language.features(p)) for p in places.split(CHUNK)]
            return torch.cat(parts)
