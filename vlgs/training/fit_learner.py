"""Trains a learner from its last checkpoint to the end of its budget, or to the first Ctrl-C."""

import logging

import lightning as L

from vlgs.fields import Field
from vlgs.runs import RunFolder
from vlgs.skip_count import SkipCount
from vlgs.training.callbacks import (
    Checkpoints,
    CurveLog,
    GracefulStop,
    OwnFolder,
    ProgressLine,
    TrainingClock,
)
from vlgs.training.checkpoint import checkpoint_bytes, keep_from, load_checkpoint
from vlgs.training.fit import FitOptions, Steps, expected_warnings, lightning_trainer
from vlgs.training.learner import Learner
from vlgs.training.workshop import Made, StoppedError, Workshop

log = logging.getLogger(__name__)


def train_learner(
    workshop: Workshop, name: str, learner: Learner, made: Field, gaussians: int = 0
) -> None:
    """Train a learner in a sub-folder of a run, or read it back, and remember what it makes.

    Args:
        workshop: Of the run.
        name: Sub-folder; empty for the folder of the run itself.
        learner: New.
        made: What asks the learner's model.
        gaussians: How many it has.

    Raises:
        StoppedError: If it was asked to stop.
    """
    folder = workshop.folder.part(name)
    if name:
        log.info("model %s of this run, in %s", name, folder.path)
    stopped_by = _fit(learner, folder, workshop.make_options())
    if stopped_by is not None:
        which = f" of {name}" if name else ""
        where = f"step {learner.next_step} of {learner.settings.iterations}{which}"
        raise StoppedError(stopped_by, where)
    learner.model.requires_grad_(False)
    size = checkpoint_bytes(folder.checkpoint)
    workshop.made[name] = Made(folder, made, gaussians, learner.train_seconds, SkipCount(), size)


def _fit(learner: Learner, folder: RunFolder, options: FitOptions) -> str | None:
    """As `vlgs.training.fit.fit`."""
    folder.require_own()
    checkpoint = load_checkpoint(folder.checkpoint)
    if checkpoint is not None:
        learner.restore(checkpoint)
        keep_from(folder.checkpoint, checkpoint.step)
        log.info("resuming %s at step %d", folder.path, learner.next_step)
    steps = Steps(learner)
    if len(steps) == 0:
        return None
    folder.path.mkdir(parents=True, exist_ok=True)
    stop, settings = GracefulStop(), learner.settings
    callbacks: list[L.Callback] = [
        OwnFolder(folder),  # before whatever writes
        TrainingClock(),
        CurveLog(folder.curves, settings.log_every),
        Checkpoints(folder.checkpoint, settings.checkpoint_every, options.meta),
        stop,
    ]
    if options.progress:
        callbacks.append(ProgressLine())
    callbacks += options.callbacks
    with expected_warnings():
        lightning_trainer(folder, callbacks, options).fit(learner, train_dataloaders=steps)
    return stop.stopped_by
