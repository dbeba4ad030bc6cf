"""Trains a module from its last checkpoint to the end of its budget, or to the first Ctrl-C."""

import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import lightning as L
from lightning.pytorch.loggers import Logger

from vlgs.ops.machine import freed_memory_kept
from vlgs.runs import RunFolder
from vlgs.training.after_step import TrainedModule
from vlgs.training.average import Average
from vlgs.training.callbacks import (
    Checkpoints,
    ClearAir,
    CurveLog,
    Densification,
    GracefulStop,
    Narrow,
    OwnFolder,
    ProgressLine,
    Silence,
    TrainingClock,
)
from vlgs.training.checkpoint import Checkpoint, keep_from, load_checkpoint
from vlgs.training.lightning import VLGSModule
from vlgs.training.mask_support import LeaveOut
from vlgs.training.state import restore
from vlgs.training.zero_gradients import StuckAlarm

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FitOptions:
    """Options of training that cannot move a number."""

    meta: dict[str, Any]
    """JSON values that go into every checkpoint, e.g. the configuration."""
    progress: bool = True
    loggers: Sequence[Logger] = ()
    callbacks: Sequence[L.Callback] = ()
    """Called after those of training itself."""


@dataclass(frozen=True)
class _Steps:
    """The iterations that remain, as Lightning wants its batches."""

    module: TrainedModule

    def __iter__(self) -> Iterator[int]:
        return iter(range(self.module.next_step, self.module.settings.iterations))

    def __len__(self) -> int:
        return self.module.settings.iterations - self.module.next_step


def fit(module: VLGSModule, folder: RunFolder, options: FitOptions) -> str | None:
    """Train Gaussians to the end of their budget; see `train_on`."""
    changes = [
        StuckAlarm(module.settings.log_every),
        Densification(),
        LeaveOut(),
        Average(),
        Narrow(),
        ClearAir(),
        Silence(),
    ]
    return train_on(module, partial(restore, module), changes, folder, options)


def train_on(
    module: TrainedModule,
    restore: Callable[[Checkpoint], None],
    changes: Sequence[L.Callback],
    folder: RunFolder,
    options: FitOptions,
) -> str | None:
    """Train what remains.

    Args:
        module: New.
        restore: Puts a checkpoint back into it.
        changes: What belongs to an iteration besides its step.
        folder: Where checkpoints lie, or will.
        options: What moves no number.

    Returns:
        None when the budget is done, else the name of the signal that stopped it; either way the last whole step is saved.

    Raises:
        FloatingPointError: If a loss or gradient is not finite; the checkpoint before it stays.
        OSError: If a checkpoint cannot be written, or the folder is deleted meanwhile; the checkpoint before stays.
    """
    folder.require_own()
    checkpoint = load_checkpoint(folder.checkpoint)
    if checkpoint is not None:
        restore(checkpoint)
        keep_from(folder.checkpoint, checkpoint.step)
        log.info("resuming %s at step %d", folder.path, module.next_step)
    steps = _Steps(module)
    if len(steps) == 0:
        return None
    folder.path.mkdir(parents=True, exist_ok=True)
    stop, settings = GracefulStop(), module.settings
    callbacks: list[L.Callback] = [
        OwnFolder(folder),  # before whatever writes
        *changes,
        TrainingClock(),  # ends an iteration after its changes
        CurveLog(folder.curves, settings.log_every),
        Checkpoints(folder.checkpoint, settings.checkpoint_every, options.meta),
        stop,
    ]
    if options.progress:
        callbacks.append(ProgressLine())
    callbacks += options.callbacks
    with _expected_warnings(), freed_memory_kept():
        _trainer(folder, callbacks, options).fit(module, train_dataloaders=steps)
    return stop.stopped_by


def _trainer(folder: RunFolder, callbacks: list[L.Callback], options: FitOptions) -> L.Trainer:
    """A Trainer with our own callbacks for checkpoints, curves and progress, and none of Lightning's."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    return L.Trainer(
        accelerator="cpu",
        max_epochs=1,
        logger=list(options.loggers),
        callbacks=callbacks,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder.path,
    )


@contextmanager
def _expected_warnings() -> Iterator[None]:
    """Silence two warnings of Lightning that are expected here."""
    with warnings.catch_warnings():
        # The head is fitted before training starts; its BatchNorm must keep the statistics it has.
        warnings.filterwarnings("ignore", message="Found .* module.* in eval mode")
        # Lightning 2.6 under torch 2.13, in its own tree utilities.
        warnings.filterwarnings("ignore", message=".*LeafSpec.* is deprecated")
        yield
