"""How many models learn the mask levels of a scene: the values of ``levels``, and the stages of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, runtime_checkable

from vlgs.config import CODES, LEVELS
from vlgs.training.joint import join_levels
from vlgs.training.stages import Progress, Stage, Stages
from vlgs.training.workshop import Workshop


@runtime_checkable
class Levels(Stages, Protocol):
    """The interface of a value of ``levels``."""

    @property
    def read(self) -> Sequence[int]:
        """Mask levels that are read; none: the one that the data says."""
        ...

    @property
    def codes(self) -> int:
        """Language codes of a Gaussian."""
        ...


@dataclass(frozen=True)
class Single:
    """One mask level."""

    one_model: ClassVar[bool] = True
    """One model learns all masks that are read."""
    read: Sequence[int] = ()
    codes: int = CODES["single"]

    def stages(self, language: bool) -> Sequence[Stage]:
        """None."""
        return []


@dataclass(frozen=True)
class Separate:
    """A model for each mask level; stages go through them by themselves."""

    read: Sequence[int] = LEVELS
    codes: int = CODES["separate"]

    def stages(self, language: bool) -> Sequence[Stage]:
        """None."""
        return []


@dataclass(frozen=True)
class Joint:
    """One model for all mask levels."""

    one_model: ClassVar[bool] = True
    joint: ClassVar[bool] = True
    """A model has something of its own for each level."""
    read: Sequence[int] = LEVELS
    codes: int = CODES["joint"]

    def stages(self, language: bool) -> Sequence[Stage]:
        """See `vlgs.training.stages.Stages`."""
        return [JoinLevels()]


LEVEL_OPTIONS: Mapping[str, Levels] = {"single": Single(), "separate": Separate(), "joint": Joint()}
"""Value of ``levels`` -> what it means."""


@dataclass(frozen=True)
class JoinLevels:
    """Makes one scene of all mask levels; whatever comes after it is one model."""

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `vlgs.training.stages.Stage`."""
        return replace(progress, scenes={None: join_levels(list(progress.scenes.values()))})
