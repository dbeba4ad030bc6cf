"""Which weight per Gaussian blends language: l in Eq. 6, or what an ablation puts in its place (conf/README.md, D.10 and D.15)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.demands import Demand
from vlgs.types import Gaussians
from vlgs.values import require_range


@runtime_checkable
class Indicator(Protocol):
    """The interface of an indicator."""

    def __call__(self, gaussians: Gaussians) -> Float[Tensor, " n *levels"]:
        """Return the weight in [0, 1] with which each Gaussian's language code is blended; one per level where they differ."""
        ...


@dataclass(frozen=True)
class Learned:
    """The smoothed semantic indicator: a parameter of its own per Gaussian (Eq. 6)."""

    without_color: ClassVar[bool] = True
    """It blends Gaussians that have no colour."""

    def __call__(self, gaussians: Gaussians) -> Float[Tensor, " n"]:
        """Return `gaussians.indicators` itself."""
        return gaussians.indicators


@dataclass(frozen=True)
class PerLevel:
    """A learned indicator of its own for every mask level (``levels=joint``)."""

    demands: ClassVar[Sequence[Demand]] = (Demand("indicator=per_level", "levels", "joint"),)
    each_level: ClassVar[bool] = True
    """A Gaussian has a parameter for every mask level."""
    without_color: ClassVar[bool] = True
    """It blends Gaussians that have no colour."""

    def __call__(self, gaussians: Gaussians) -> Float[Tensor, " n *levels"]:
        """Return `gaussians.indicators` itself: [n] where a model has no levels (the colour of ``sharing=none``)."""
        return gaussians.indicators


@dataclass(frozen=True)
class Opacity:
    """Language blended with the colour opacity, as earlier systems do (Eq. 2).

    Raises:
        ValueError: If `copies` is outside [1, 1000].
    """

    untrained: ClassVar[bool] = True
    """It learns nothing beside colour."""
    detach: bool = False
    """Whether the language loss is kept from moving the opacity; the paper lets it (conf/README.md, D.15)."""
    copies: float = 1.0
    """How often a Gaussian stands in its place for language: ``1 - (1 - opacity)^copies``. Above 1 what lies behind glass says less of the glass."""

    def __post_init__(self) -> None:
        require_range("opacity", 1, 1000, copies=self.copies)

    def __call__(self, gaussians: Gaussians) -> Float[Tensor, " n"]:
        """Return `gaussians.opacities` itself, so that the rasteriser runs one transmittance chain for both modalities, or of more copies a new tensor."""
        opacities = gaussians.opacities.detach() if self.detach else gaussians.opacities
        return opacities if self.copies == 1 else 1 - (1 - opacities) ** self.copies


@dataclass(frozen=True)
class Fixed:
    """One constant for every Gaussian, not learned (the "fixed to" rows of Table 4 B).

    Raises:
        ValueError: If the value is outside [0, 1].
    """

    untrained: ClassVar[bool] = True
    """There is nothing to learn."""
    without_color: ClassVar[bool] = True
    """It blends Gaussians that have no colour."""
    value: float
    """Above `RasterConfig.alpha_max` the rasteriser caps it."""

    def __post_init__(self) -> None:
        if not 0 <= self.value <= 1:
            raise ValueError(f"Fixed: value must be in [0, 1], got {self.value}")

    def __call__(self, gaussians: Gaussians) -> Float[Tensor, " n"]:
        """Return a new tensor without gradient."""
        return torch.full_like(gaussians.opacities, self.value, requires_grad=False)
