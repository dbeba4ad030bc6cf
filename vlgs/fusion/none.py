"""No fusion: colour and language stay apart until they are rasterised."""

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn


class NoFusion(nn.Module):
    """Return colour and language code as they are: ``u = c (+) f`` (the "no fusion" row of Table 4)."""

    separable: ClassVar[bool] = True
    """Colour and language may be in different models."""
    untrained: ClassVar[bool] = True
    """There is nothing to learn."""

    def forward(
        self, color: Float[Tensor, "n dc"], feature: Float[Tensor, "n df"]
    ) -> tuple[Float[Tensor, "n dc"], Float[Tensor, "n df"]]:
        """Return both arguments; see `vlgs.fusion.Fusion`."""
        return color, feature
