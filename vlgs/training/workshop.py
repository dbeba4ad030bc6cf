"""Where the models of a run are trained: each in a sub-folder of the run, with its own checkpoint and log.csv.

A finished model is loaded from its checkpoint, so that the same command continues where it was stopped.
"""

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from vlgs.fields import Field
from vlgs.fields.saved import plan_of_model
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import SplatField
from vlgs.runs import RunFolder
from vlgs.skip_count import SkipCount
from vlgs.training.after_step import TrainedModule
from vlgs.training.build import Parts, build_module
from vlgs.training.checkpoint import checkpoint_bytes, load_checkpoint, save_checkpoint
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lift import lift_features
from vlgs.training.lift_rules import LiftRule, lift_by
from vlgs.training.lightning import VLGSModule
from vlgs.training.state import capture, restore
from vlgs.types import Scene

log = logging.getLogger(__name__)


class StoppedError(Exception):
    """Training was asked to stop; what was reached is saved."""

    def __init__(self, signal: str, where: str) -> None:
        super().__init__(f"{signal}: stopped and saved at {where}")


def require_done(module: TrainedModule, stopped_by: str | None, name: str) -> None:
    """Do nothing if a model of this name was trained to the end.

    Raises:
        StoppedError: If it was asked to stop.
    """
    if stopped_by is not None:
        which = f" of {name}" if name else ""
        where = f"step {module.next_step} of {module.settings.iterations}{which}"
        raise StoppedError(stopped_by, where)


@dataclass(frozen=True)
class Made:
    """One model of a run, and what it took to make it."""

    folder: RunFolder
    field: Field
    gaussians: int
    """How many it has."""
    seconds: float
    """Of training."""
    skips: SkipCount
    checkpoint_bytes: int
    kept: bool = True
    """Off: it only prepared others, and is no part of the result."""


def unchanged(parts: Parts) -> Parts:
    """The parts as the command line chose them."""
    return parts


@dataclass
class Workshop:
    """Makes models in sub-folders of a run, and remembers them.

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
    made: dict[str, Made] = field(default_factory=dict)
    """Sub-folder -> model, in the order in which they were made."""

    @property
    def kept(self) -> list[Made]:
        """The models that the result consists of."""
        return [made for made in self.made.values() if made.kept]

    def train(
        self,
        name: str,
        scene: Scene,
        change: Callable[[Parts], Parts] = unchanged,
        start: SplatModel | None = None,
        color: bool = True,
        kept: bool = True,
        codes: bool = True,
    ) -> SplatField:
        """Train a model, or read it back.

        Args:
            name: Sub-folder; empty for the folder of the run itself.
            scene: What it learns.
            change: What is different from the parts that the command line chose.
            start: Whose Gaussians it starts from; None: what the parts say.
            color: Off: language alone; colours that it starts with stay as they are.
            kept: See `Made`.
            codes: See `build_module`.

        Raises:
            StoppedError: If it was asked to stop.
        """
        folder = self.folder.part(name)
        if name:
            log.info("model %s, a part of this run", name)
        module = self._build(scene, change(self.make_parts()), start, color, codes)
        stopped_by = fit(module, folder, self._options(module, color or start is not None))
        require_done(module, stopped_by, name)
        module.step.frozen = None  # weights of views: what comes after training needs the memory
        return self._remember(name, module, color or start is not None, kept)

    def lift(
        self, name: str, scene: Scene, start: SplatModel, rule: LiftRule | None = None
    ) -> SplatField:
        """Lift the language of a scene onto finished Gaussians, or read it back; the folder is as that of a trained model.

        Where the scene has no masks the Gaussians stay as they are.

        Args:
            name: Sub-folder; empty for the folder of the run itself.
            scene: Whose masks count.
            start: Trained on colour.
            rule: From masks to codes; None: the mean of codes (`lift_features`).
        """
        folder, started = self.folder.part(name), time.perf_counter()
        module = self._build(scene, self.make_parts(), start)
        finished = load_checkpoint(folder.checkpoint)
        if finished is not None:
            restore(module, finished)
            return self._remember(name, module)
        module.model.sh_degree = start.sh_degree
        # Rules differentiate by what they blend, and by nothing else.
        module.model.requires_grad_(False)
        if len(scene.mask_vectors):
            lift_features(module) if rule is None else lift_by(rule, module)
        module.next_step = module.settings.iterations
        module.train_seconds = time.perf_counter() - started
        folder.require_own()
        save_checkpoint(folder.checkpoint, capture(module, self._options(module, True).meta))
        return self._remember(name, module)

    def _options(self, module: VLGSModule, color: bool) -> FitOptions:
        """With what a checkpoint says of the field that it holds, so that a training can be looked at (`vlgs.opened`)."""
        options = self.make_options()
        plan = plan_of_model(module.model, color, module.views.has_language)
        return replace(options, meta={**options.meta, "plan": plan})

    def _build(
        self,
        scene: Scene,
        parts: Parts,
        start: SplatModel | None,
        color: bool = True,
        codes: bool = True,
    ) -> VLGSModule:
        if start is None:
            return build_module(scene, parts, self.seed, color, codes=codes)
        # Copies: training moves them in place, and other models may start from the same ones.
        splats = {name: value.detach().clone() for name, value in start.splats.items()}
        return build_module(scene, parts, self.seed, color, splats)

    def _remember(
        self, name: str, module: VLGSModule, color: bool = True, kept: bool = True
    ) -> SplatField:
        folder = self.folder.part(name)
        field = SplatField(module.model, color, language=module.views.has_language)
        size, seconds = checkpoint_bytes(folder.checkpoint), module.train_seconds
        self.made[name] = Made(folder, field, module.model.count, seconds, module.skips, size, kept)
        return field


def all_skips(made: Iterable[Made]) -> SkipCount:
    """The skips of several models together."""
    total = SkipCount()
    for one in made:
        for name, work in one.skips.work.items():
            total.add(name, work.done, work.seconds)
        for name, count in one.skips.skipped.items():
            total.skip(name, count)
    return total
