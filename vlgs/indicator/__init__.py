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


COLORLESS = 1e-30
"""Opacity up to which a Gaussian is none of colour's: those of language alone have less (`vlgs.training.separate`)."""


@dataclass(frozen=True)
class Trained:
    """An indicator that is a parameter of its own.

    Raises:
        ValueError: If `reach` is outside [0, 1e6].
    """

    without_color: ClassVar[bool] = True
    """It blends Gaussians that have no colour."""
    reach: float = 0.0
    """Above 0 a Gaussian's indicator counts times ``min(1, reach * opacity)``, which moves no opacity: what colour hardly sees says little. Language that may be
    seen where colour sees nothing explains what views disagree about by fog of its own before every camera, as colour does without a background. 0: the paper's."""

    def __post_init__(self) -> None:
        require_range("indicator", 0, 1e6, reach=self.reach)

    def __call__(self, gaussians: Gaussians) -> Float[Tensor, " n *levels"]:
        """Return `gaussians.indicators` itself where nothing bounds it: one for each mask level where a model has levels, [n] where it has none."""
        if not self.reach:
            return gaussians.indicators
        opacities = gaussians.opacities.detach()
        seen = (self.reach * opacities).clamp(max=1)
        seen = torch.where(opacities > COLORLESS, seen, torch.ones_like(seen))
        return gaussians.indicators * (seen if gaussians.indicators.dim() == 1 else seen[:, None])


@dataclass(frozen=True)
class Learned(Trained):
    """The smoothed semantic indicator: a parameter of its own per Gaussian (Eq. 6)."""


@dataclass(frozen=True)
class PerLevel(Trained):
    """A learned indicator of its own for every mask level (``levels=joint``)."""

    demands: ClassVar[Sequence[Demand]] = (Demand("indicator=per_level", "levels", "joint"),)
    each_level: ClassVar[bool] = True
    """A Gaussian has a parameter for every mask level."""


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
