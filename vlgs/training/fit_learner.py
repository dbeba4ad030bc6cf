"""Trains a learner from its last checkpoint to the end of its budget, or to the first Ctrl-C."""

import logging

from vlgs.fields import Field
from vlgs.skip_count import SkipCount
from vlgs.training.checkpoint import checkpoint_bytes
from vlgs.training.fit import train_on
from vlgs.training.learner import Learner
from vlgs.training.workshop import Made, Workshop, require_done

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
        log.info("model %s, a part of this run", name)
    stopped_by = train_on(learner, learner.restore, (), folder, workshop.make_options())
    require_done(learner, stopped_by, name)
    learner.model.requires_grad_(False)
    size = checkpoint_bytes(folder.checkpoint)
    workshop.made[name] = Made(folder, made, gaussians, learner.train_seconds, SkipCount(), size)
