"""A trained scene asked in 3D: the relevancy of every Gaussian, and silhouettes of those that were selected."""

from collections.abc import Sequence
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.metrics.protocol import Splats
from vlgs.query import Prompts, Query, decoded_cosines
from vlgs.report.answer import Fused, ViewModel
from vlgs.types import Camera


class SplatAnswers:
    """What `vlgs.metrics.select3d` needs; Gaussians are decoded once for all views.

    Args:
        models: One per mask level.
        fused: `fuse()` of each.
        query: How relevancy is computed.
        prompts: The scene's classes, encoded.
    """

    def __init__(
        self, models: Sequence[ViewModel], fused: Sequence[Fused], query: Query, prompts: Prompts
    ) -> None:
        self.models = models
        self.fused = fused
        self.query = query
        self.prompts = prompts

    @cached_property
    def relevancy(self) -> list[Float[Tensor, "k n"]]:
        """Of each class for each Gaussian, per level."""
        return [
            self._ask(model, fused) for model, fused in zip(self.models, self.fused, strict=True)
        ]

    def seen_by(self, camera: Camera) -> Splats:
        """Relevancy, and silhouettes from a camera: selected Gaussians keep what blends language, all others weigh 0."""

        def silhouette(level: int, selected: Bool[Tensor, " n"]) -> Float[Tensor, "h w"]:
            weight = self.fused[level].language_weight * selected
            values = torch.ones(len(selected), 1, dtype=weight.dtype)
            return self.models[level].render_values(camera, values, weight)[..., 0]

        return Splats(self.relevancy, silhouette)

    def _ask(self, model: ViewModel, fused: Fused) -> Float[Tensor, "k n"]:
        words = torch.cat([self.prompts.text, self.prompts.negatives])
        both = decoded_cosines(model.codec.decode, fused.feature[None], words)[:, 0]
        own, negatives = both.split([len(self.prompts.text), len(self.prompts.negatives)])
        return self.query.relevancy(own, negatives)
