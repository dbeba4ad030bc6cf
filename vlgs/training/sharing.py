"""What colour and language have in common (Table 17; conf/README.md, D.16): the options of conf/sharing, and the stages of each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from vlgs.demands import Demand
from vlgs.fields.trained import SplatField
from vlgs.training.separate import for_language, unite
from vlgs.training.stages import Lift, Progress, Stage, Train, TrainColor
from vlgs.training.workshop import Workshop


def choose_sharing(
    means: bool = True, covariances: bool = True, lifted: bool = False
) -> "OneModel | TwoModels | Lifted":
    """The sharing with these properties.

    Args:
        means: Off: two sets of Gaussians, one for colour and one for language, each trained by its own losses.
        covariances: Off: a second rotation and scale per Gaussian, with which language is blended.
        lifted: On: language is not trained, but lifted onto what colour alone has learned (`vlgs.training.lift`).

    Raises:
        ValueError: If covariances are shared by Gaussians that are not, or lifted language should have its own.
    """
    if covariances and not means:
        raise ValueError("sharing: covariances must be false where means is false, got true")
    if lifted and not covariances:
        raise ValueError("sharing: covariances must be true where lifted is true, got false")
    if lifted:
        return Lifted()
    return OneModel(own_shape=not covariances) if means else TwoModels()


@dataclass(frozen=True)
class OneModel:
    """One set of Gaussians for both."""

    replaceable: ClassVar[bool] = True
    """A method's own stages may take the place of these."""
    own_shape: bool = False
    """See `vlgs.gaussians.Sharing`."""

    def stages(self, language: bool) -> Sequence[Stage]:
        """See `vlgs.training.stages.Stages`."""
        return [Train()]


@dataclass(frozen=True)
class TwoModels:
    """Two sets of Gaussians that know nothing of each other."""

    demands: ClassVar[Sequence[Demand]] = (
        Demand(
            "sharing=none",
            "fusion",
            "separable",
            "as a Gaussian then carries colour or language but not both",
        ),
    )
    own_shape: bool = False
    """See `vlgs.gaussians.Sharing`; the Gaussians of language are its own altogether."""

    def stages(self, language: bool) -> Sequence[Stage]:
        """See `vlgs.training.stages.Stages`."""
        color = TrainColor("color")
        return [color, TrainLanguage("language"), Unite()] if language else [color]


@dataclass(frozen=True)
class Lifted:
    """One set of Gaussians that colour alone has placed; they are given language in the end."""

    demands: ClassVar[Sequence[Demand]] = tuple(
        replace(demand, asker="sharing=lifted") for demand in Lift.demands
    )
    own_shape: bool = False
    """See `vlgs.gaussians.Sharing`."""

    def stages(self, language: bool) -> Sequence[Stage]:
        """See `vlgs.training.stages.Stages`."""
        return [TrainColor("geometry", kept=False), Lift("geometry")] if language else [Train()]


@dataclass(frozen=True)
class TrainLanguage:
    """Trains Gaussians on language alone, a model for each mask level that has masks."""

    name: str
    """Of the sub-folder."""

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `vlgs.training.stages.Stage`."""
        models = {
            level: workshop.train(
                progress.folder(level, self.name), scene, for_language, color=False
            )
            for level, scene in progress.scenes.items()
            if len(scene.mask_vectors)
        }
        return progress.having(self.name, models)


@dataclass(frozen=True)
class Unite:
    """Joins the Gaussians of colour and of language in one model; nothing is trained or written."""

    color: str = "color"
    language: str = "language"

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `vlgs.training.stages.Stage`. A mask level without a single mask is colour alone."""
        models = {
            level: self._united(progress, level, bool(len(scene.mask_vectors)))
            for level, scene in progress.scenes.items()
        }
        return progress.having("", models)

    def _united(self, progress: Progress, level: int | None, language: bool) -> SplatField:
        color = progress.gaussians(self.color, level)
        both = unite(color, progress.gaussians(self.language, level)) if language else color
        return SplatField(both, language=language)
