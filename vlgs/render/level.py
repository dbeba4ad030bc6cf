"""One mask level of a model that has codes for several (``levels=joint``): what a query is asked of."""

from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from vlgs.render.model import FusedGaussians, SplatModel, ViewRender
from vlgs.types import Camera


class LevelModel:
    """A model as one of its mask levels sees it: the same Gaussians and colour, the codes and the indicator of that level.

    Args:
        model: Trained with ``levels=joint``.
        level: Place of the level among the model's, from 0.

    Raises:
        ValueError: If the model has no such level.
    """

    def __init__(self, model: SplatModel, level: int) -> None:
        if not 0 <= level < model.levels:
            raise ValueError(f"level model: level must be below {model.levels}, got {level}")
        self.model = model
        self.level = level
        self.codec = model.codec

    def fuse(self) -> FusedGaussians:
        """Fusion over colour and the codes of all levels, of which those of this one are handed on."""
        fused = self.model.fuse()
        weight = fused.language_weight
        return replace(
            fused,
            feature=fused.feature.chunk(self.model.levels, dim=1)[self.level],
            language_weight=weight if weight.dim() == 1 else weight[:, self.level].contiguous(),
            level=self.level,
        )

    def render(
        self,
        camera: Camera,
        color: bool = True,
        language: bool = True,
        fused: FusedGaussians | None = None,
    ) -> ViewRender:
        """See `SplatModel.render`; `fused` is what `fuse` of this very level returned."""
        return self.model.render(camera, color, language, self.fuse() if fused is None else fused)

    def render_values(
        self, camera: Camera, values: Float[Tensor, "n c"], weight: Float[Tensor, " n"]
    ) -> Float[Tensor, "h w c"]:
        """See `SplatModel.render_values`."""
        return self.model.render_values(camera, values, weight)


def by_level(model: SplatModel) -> Sequence[SplatModel | LevelModel]:
    """A model per mask level, finest first: the model itself where there is one level."""
    if model.levels == 1:
        return [model]
    return [LevelModel(model, level) for level in range(model.levels)]
