"""A method is an ordered list of stages. Each goes from a scene, and from what the stages before it made, to a trained model.

The options of a run contribute their parts of the list: `vlgs.training.augment` further training views, `vlgs.training.levels` what
happens to the mask levels, `vlgs.training.sharing` the models themselves.

A stage makes each of its models in a sub-folder of the run, named after the mask level and the stage. A model that is finished there is
read back, one that is not goes on from its checkpoint: the same command continues where it was stopped, with the same bits.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar, Protocol, runtime_checkable

from vlgs.demands import Demand, has
from vlgs.fields import Field
from vlgs.fields.several import SeveralFields
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import SplatField
from vlgs.training.build import Parts, scaled
from vlgs.training.lift_rules import LiftRule
from vlgs.training.separate import without_language
from vlgs.training.workshop import Workshop
from vlgs.types import Scene
from vlgs.values import require_range

_TAKEN = ("augment", "checkpoint", "renders")
"""Folders of a run that are no stage's of a method."""

_NO_CODES = "as codes=sparse keeps weights of a codebook's entries"

SHARES = (1e-4, 100)
"""Least and most iterations of a stage, in those of ``trainer``."""

Level = int | None
"""A mask level; None where a scene has no levels, or where something is of all levels."""


@dataclass(frozen=True)
class Progress:
    """How far a run is: the scenes that are learned, and the models that are there."""

    scenes: Mapping[Level, Scene]
    """Mask level -> the scene with the supervision of that level."""
    models: Mapping[str, Mapping[Level, Field]] = field(default_factory=dict)
    """Name of a stage -> mask level -> its model; a model of all levels stands under None. The last stage is last."""

    def folder(self, level: Level, name: str) -> str:
        """Sub-folder of a stage's model: ``level_2/language``; the level is left out where there is one."""
        prefix = f"level_{level}" if len(self.scenes) > 1 else ""
        return "/".join(filter(None, [prefix, name]))

    def model(self, name: str, level: Level) -> Field:
        """What an earlier stage made for a mask level.

        Raises:
            ValueError: If no stage of that name came before.
        """
        _require_earlier(name, self.models)
        models = self.models[name]
        return models[level] if level in models else models[None]

    def gaussians(self, name: str, level: Level) -> SplatModel:
        """The same where Gaussians are needed.

        Raises:
            ValueError: If no stage of that name came before, or it made something else.
        """
        model = self.model(name, level)
        if not isinstance(model, SplatField):
            raise ValueError(f"stages: {name!r} must make Gaussians to start from, got none")
        return model.model

    def having(self, name: str, models: Mapping[Level, Field]) -> "Progress":
        """One stage further."""
        before = {own: made for own, made in self.models.items() if own != name}
        return replace(self, models={**before, name: models})

    def field(self) -> Field:
        """The trained scene, of all mask levels in their order: what the last stage made."""
        *_, last = self.models
        models = [self.model(last, level) for level in self.scenes]
        return models[0] if len(models) == 1 else SeveralFields(models)


@runtime_checkable
class Stage(Protocol):
    """One stage of a method; a frozen dataclass of its settings."""

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """Make what is missing, and return what is there then.

        Raises:
            StoppedError: If it was asked to stop.
        """
        ...


@runtime_checkable
class Particular(Protocol):
    """A stage that not every scene will do for."""

    def require(self, scenes: Mapping[Level, Scene]) -> None:
        """Refuse what it cannot learn from, before anything is trained.

        Raises:
            ValueError: If a scene lacks something.
        """
        ...


@runtime_checkable
class Stages(Protocol):
    """An option that contributes to the list of stages."""

    def stages(self, language: bool) -> Sequence[Stage]:
        """The option's part of the list; `language` is off where a scene has nothing to learn it from."""
        ...


@dataclass(frozen=True)
class Method:
    """The stages that a configuration lists, in place of those of ``sharing``.

    Raises:
        ValueError: If a stage starts from one that does not come before it, two have one name, or there is none.
    """

    listed: Sequence[Stage]

    def __post_init__(self) -> None:
        names: list[str] = []
        for stage in self.listed:
            name, start = getattr(stage, "name", None), getattr(stage, "start", None)
            if start is not None:
                _require_earlier(start, names)
            if name in names:
                raise ValueError(f"stages: name must differ from those before it, got {name!r}")
            if name in _TAKEN or not re.fullmatch(r"[a-z0-9_]*", name or ""):
                raise ValueError(
                    f"stages: name must be of small letters, digits and _, and none of {', '.join(_TAKEN)}, got {name!r}"
                )
            names += [] if name is None else [name]
        if not self.listed:
            raise ValueError("stages: there must be at least one, got none")

    @property
    def demands(self) -> Sequence[Demand]:
        """Those of its stages, and that nothing else says how models are made."""
        asked = [demand for stage in self.listed for demand in getattr(stage, "demands", ())]
        asked += getattr(self.listed[-1], "demands_at_end", ())
        why = "as the stages say how models are made"
        return [Demand("stages of a method", "sharing", "replaceable", why), *asked]

    @property
    def without_gaussians(self) -> bool:
        """Whether none of its stages makes a Gaussian, which they say themselves."""
        return all(has(stage, "without_gaussians") for stage in self.listed)

    def stages(self, language: bool) -> Sequence[Stage]:
        """See `Stages`."""
        return self.listed

    def require(self, scenes: Mapping[Level, Scene]) -> None:
        """Refuse scenes that a stage cannot learn from.

        Raises:
            ValueError: If a scene lacks something; it is named.
        """
        for stage in self.listed:
            if isinstance(stage, Particular):
                stage.require(scenes)


def run_stages(
    options: Iterable[Stages], scenes: Mapping[Level, Scene], workshop: Workshop
) -> Progress:
    """Make everything that a run is made of.

    Args:
        options: In the order of their stages.
        scenes: Mask level -> the scene with the supervision of that level. Where none has language the last one stands for all.
        workshop: Where and with what.

    Raises:
        StoppedError: If training was asked to stop.
    """
    language = any(len(scene.mask_vectors) for scene in scenes.values())
    progress = Progress(scenes if language else dict(list(scenes.items())[-1:]))
    for stage in list_stages(options, language):
        progress = stage.run(progress, workshop)
    return progress


def list_stages(options: Iterable[Stages], language: bool = True) -> Iterator[Stage]:
    """The stages of a run, in their order."""
    for option in options:
        yield from option.stages(language)


@dataclass(frozen=True)
class Train:
    """Trains Gaussians on the colour and the language of a scene, a model for each mask level."""

    name: str = ""
    """Of the sub-folder; empty for the folder of the run, or of the mask level."""
    start: str | None = None
    """The earlier stage whose Gaussians it starts from; None: those of ``gaussians``."""
    freeze: Sequence[str] = ()
    """Parameters that keep their values beside those of ``trainer.freeze``; with any of them nothing is densified."""
    color: bool = True
    """Off: language alone is trained, and the model still shows the colours that it starts with."""
    share: float = 1.0
    """Of the iterations of ``trainer``; schedules shrink with them (`vlgs.training.build.scaled`)."""

    def __post_init__(self) -> None:
        require_range("train", *SHARES, share=self.share)

    @property
    def demands(self) -> Sequence[Demand]:
        """That nobody expects an indicator to be learned where it is frozen at its first value, or codes to be without a loss."""
        asked = []
        if "indicator_logits" in self.freeze:
            asker, why = "a stage that freezes indicator_logits", "as nothing trains it"
            asked.append(Demand(asker, "indicator", "untrained", why))
        if not self.color:
            asker, why = "a stage without colour", "as it trains language alone"
            asked.append(Demand(asker, "loss", "teaches_codes", why))
        return asked

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `Stage`. Without masks, and without colour to train, the model stays as it starts."""
        models = {}
        for level, scene in progress.scenes.items():
            start = None if self.start is None else progress.gaussians(self.start, level)
            folder = progress.folder(level, self.name)
            if start is not None and not self.color and not len(scene.mask_vectors):
                models[level] = workshop.lift(folder, scene, start)
            else:
                models[level] = workshop.train(folder, scene, self._change, start, self.color)
        return progress.having(self.name, models)

    def _change(self, parts: Parts) -> Parts:
        parts = scaled(parts, self.share)
        if self.start is None and not self.freeze:
            return parts
        trainer, gaussians = parts.trainer, parts.gaussians
        frozen = dict.fromkeys([*trainer.freeze, *self.freeze])
        # Harmonics that come trained are not taken away again: every degree is there after three iterations.
        every = trainer.sh_every if self.start is None else 1
        trainer = replace(trainer, freeze=list(frozen), sh_every=every)
        stop = 0 if frozen else gaussians.densify.stop
        gaussians = replace(gaussians, densify=replace(gaussians.densify, stop=stop))
        return replace(parts, trainer=trainer, gaussians=gaussians)


@dataclass(frozen=True)
class TrainColor:
    """Trains Gaussians on colour alone: one model, whatever the mask levels."""

    demands_at_end: ClassVar[Sequence[Demand]] = tuple(
        Demand("a method of colour alone", group, "untrained", "as there is no language")
        for group in ("fusion", "indicator")
    )
    """What it asks where nothing comes after it."""
    name: str
    """Of the sub-folder."""
    kept: bool = True
    """Off: it only prepares others, and is no part of the result."""
    share: float = 1.0
    """Of the iterations of ``trainer``; schedules shrink with them."""

    def __post_init__(self) -> None:
        require_range("train_color", *SHARES, share=self.share)

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `Stage`."""
        scene = without_language(next(iter(progress.scenes.values())))
        change = partial(scaled, share=self.share)
        trained = workshop.train(self.name, scene, change, kept=self.kept, codes=self.kept)
        model = SplatField(trained.model, language=False)
        return progress.having(self.name, {None: model})


@dataclass(frozen=True)
class Lift:
    """Gives every Gaussian of an earlier stage a code of the masked pixels that it is blended into; nothing is trained."""

    demands: ClassVar[Sequence[Demand]] = (
        *(
            Demand("language that is lifted", group, "untrained", "as nothing trains it")
            for group in ("fusion", "indicator", "head")
        ),
        Demand("language that is lifted", "gaussians", "takes_codes", _NO_CODES),
    )
    start: str
    """The earlier stage."""
    name: str = ""
    """Of the sub-folder; empty for the folder of the run, or of the mask level."""
    lift: LiftRule | None = None
    """From masks to a code; None: the mean of codes (`vlgs.training.lift`)."""

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `Stage`. A mask level without a single mask has nothing to be lifted: its Gaussians stay as they are."""
        models = {}
        for level, scene in progress.scenes.items():
            folder = progress.folder(level, self.name)
            start = progress.gaussians(self.start, level)
            models[level] = workshop.lift(folder, scene, start, self.lift)
        return progress.having(self.name, models)


def _require_earlier(name: str, known: Collection[str]) -> None:
    if name not in known:
        listed = ", ".join(map(repr, known)) or "none"
        raise ValueError(f"stages: start must be an earlier stage ({listed}), got {name!r}")
