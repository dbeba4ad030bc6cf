"""The stages of a run: the models that it trains, one after the other.

Most runs train one model, in the folder of the run. Others train several, each in a sub-folder with its own checkpoint and
log.csv. A finished stage is loaded from its checkpoint, so that the same command continues where it was stopped.
"""

import logging
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import torch

from vlgs.fields import Field
from vlgs.fields.several import SeveralFields
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import SplatField
from vlgs.gaussians import Sharing
from vlgs.module.augment import NoAugment, Offline
from vlgs.module.build import Parts, build_module
from vlgs.module.checkpoint import checkpoint_bytes, save_checkpoint
from vlgs.module.fit import FitOptions, fit
from vlgs.module.joint import join_levels
from vlgs.module.lift import lift_features
from vlgs.module.lightning import VLGSModule
from vlgs.module.separate import for_language, unite, without_language
from vlgs.module.state import capture
from vlgs.runs import RunFolder
from vlgs.skip_count import SkipCount
from vlgs.types import Scene

log = logging.getLogger(__name__)

AUGMENT = "augment"
"""Name of the model that renders further training views."""
GEOMETRY = "geometry"
"""Name of the model of colour that language is lifted onto."""


class StoppedError(Exception):
    """Training was asked to stop; what was reached is saved."""

    def __init__(self, signal: str, where: str) -> None:
        super().__init__(f"{signal}: stopped and saved at {where}")


@dataclass(frozen=True)
class Stage:
    """One trained model."""

    folder: RunFolder
    model: SplatModel
    seconds: float
    """Of training."""
    skips: SkipCount
    checkpoint_bytes: int
    color: bool = True
    """Off: trained for language alone."""

    @property
    def field(self) -> Field:
        """What was trained."""
        return SplatField(self.model, self.color)


@dataclass
class Stages:
    """Trains models in sub-folders of a run.

    Args:
        folder: Of the run.
        make_parts: Fresh parts, which hold weights; called once per model, with the same random numbers each time.
        make_options: Likewise, as loggers belong to one training.
        seed: Of the run.
    """

    folder: RunFolder
    make_parts: Callable[[], Parts]
    make_options: Callable[[], FitOptions]
    seed: int
    done: dict[str, Stage] = field(default_factory=dict)
    """Name -> stage, in the order of training."""

    @property
    def kept(self) -> list[Stage]:
        """The stages that the result consists of, without those that only prepared others."""
        return [stage for name, stage in self.done.items() if name not in (AUGMENT, GEOMETRY)]

    def train(self, name: str, scene: Scene, color: bool = True) -> SplatModel:
        """Train a model, or read it back.

        Args:
            name: Sub-folder; empty for the folder of the run itself.
            scene: What it learns.
            color: Off: language alone.

        Raises:
            StoppedError: If it was asked to stop.
        """
        folder = self.folder.part(name)
        if name:
            log.info("model %s of this run, in %s", name, folder.path)
        parts = self.make_parts()
        module = build_module(scene, parts if color else for_language(parts), self.seed, color)
        stopped_by = fit(module, folder, self.make_options())
        if stopped_by is not None:
            stage = f" of {name}" if name else ""
            where = f"step {module.next_step} of {module.settings.iterations}{stage}"
            raise StoppedError(stopped_by, where)
        return self._finish(name, folder, module, color)

    def lift(self, name: str, geometry: SplatModel, scene: Scene) -> SplatModel:
        """Lift the language of a scene onto finished Gaussians (`lift_features`); the folder is as that of a trained model.

        Args:
            name: Sub-folder; empty for the folder of the run itself.
            geometry: Trained on colour.
            scene: Whose masks count.
        """
        folder, started = self.folder.part(name), time.perf_counter()
        parts = self.make_parts()
        start = {key: value.detach() for key, value in geometry.splats.items()}
        start["features"] = torch.zeros(geometry.count, parts.head.dim * scene.mask_levels)
        module = build_module(scene, parts, self.seed, start=start)
        module.model.sh_degree = geometry.sh_degree
        lift_features(module)
        module.next_step = module.settings.iterations
        module.train_seconds = time.perf_counter() - started
        folder.require_own()
        save_checkpoint(folder.checkpoint, capture(module, self.make_options().meta))
        return self._finish(name, folder, module)

    def _finish(
        self, name: str, folder: RunFolder, module: VLGSModule, color: bool = True
    ) -> SplatModel:
        size, seconds = checkpoint_bytes(folder.checkpoint), module.train_seconds
        self.done[name] = Stage(folder, module.model, seconds, module.skips, size, color)
        return module.model


def train_all(
    stages: Stages,
    scenes: Mapping[int | None, Scene],
    sharing: Sharing,
    augment: Offline | NoAugment,
    joint: bool = False,
) -> Field:
    """Train everything that a run is made of.

    Args:
        stages: Where and with what.
        scenes: Mask level -> the scene with the supervision of that level; one, or several for ``levels=separate`` and ``joint``.
        sharing: Whether colour and language are one model, and whether language is trained at all.
        augment: Further training views, rendered from a first model of colour alone (conf/README.md, D.17); what `Offline.require`
            asks for is there.
        joint: Whether one model learns all levels.

    Returns:
        The trained scene, of all mask levels in their order.

    Raises:
        StoppedError: If training was asked to stop.
    """
    if not any(len(scene.mask_vectors) for scene in scenes.values()):
        scenes = dict(list(scenes.items())[-1:])
    if isinstance(augment, Offline):
        first = stages.train(AUGMENT, without_language(next(iter(scenes.values()))))
        maps = stages.folder.path / AUGMENT / "language"
        scenes = augment.extend(scenes, first, stages.seed, maps)
    if joint:
        scenes = {None: join_levels(list(scenes.values()))}
    models, color = [], None
    for level, scene in scenes.items():
        name = f"level_{level}" if len(scenes) > 1 else ""
        if sharing.lifted and len(scene.mask_vectors):
            color = color or stages.train(GEOMETRY, without_language(scene))
            models.append(stages.lift(name, color, scene))
            continue
        if sharing.means:
            models.append(stages.train(name, scene))
            continue
        color = color or stages.train("color", without_language(scene))
        if len(scene.mask_vectors) == 0:
            models.append(color)
        else:
            language = stages.train("/".join(filter(None, [name, "language"])), scene, color=False)
            models.append(unite(color, language))
    fields = [SplatField(model) for model in models]
    return fields[0] if len(fields) == 1 else SeveralFields(fields)


def all_skips(stages: Iterable[Stage]) -> SkipCount:
    """The skips of all stages together."""
    total = SkipCount()
    for stage in stages:
        for name, work in stage.skips.work.items():
            total.add(name, work.done, work.seconds)
        for name, count in stage.skips.skipped.items():
            total.skip(name, count)
    return total
