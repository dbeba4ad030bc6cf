"""A trained scene asked in 3D: the relevancy of every Gaussian, and silhouettes of those that were selected."""

from collections.abc import Sequence
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.fields import HasGaussians
from vlgs.metrics.protocol import GaussianEvidence
from vlgs.queries import Prompts, Query
from vlgs.types import Camera


class SplatAnswers:
    """What `vlgs.metrics.select3d` needs; Gaussians are asked once for all views.

    Args:
        levels: The Gaussians of each mask level.
        query: How relevancy is computed.
        prompts: The scene's classes, encoded.
    """

    def __init__(self, levels: Sequence[HasGaussians], query: Query, prompts: Prompts) -> None:
        self.levels = levels
        self.query = query
        self.prompts = prompts

    @cached_property
    def relevancy(self) -> list[Float[Tensor, "k n"]]:
        """Of each class for each Gaussian, per level."""
        return [self._ask(level) for level in self.levels]

    def seen_by(self, camera: Camera) -> GaussianEvidence:
        """Relevancy, and silhouettes from a camera: selected Gaussians keep what blends language, all others weigh 0."""

        def silhouette(level: int, selected: Bool[Tensor, " n"]) -> Float[Tensor, "h w"]:
            gaussians = self.levels[level]
            weight = gaussians.language_weights() * selected
            values = torch.ones(len(selected), 1, dtype=weight.dtype)
            return gaussians.render_values(camera, values, weight)[..., 0]

        return GaussianEvidence(self.relevancy, silhouette)

    def _ask(self, level: HasGaussians) -> Float[Tensor, "k n"]:
        words = torch.cat([self.prompts.text, self.prompts.negatives])
        both = level.gaussian_similarity(words)[0]
        own, negatives = both.split([len(self.prompts.text), len(self.prompts.negatives)])
        return self.query.relevancy(own, negatives)
