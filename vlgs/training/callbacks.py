"""Callbacks of training: densification, checkpoints, the progress bar, log.csv, and stopping on Ctrl-C."""

import logging
import math
import os
import signal
import threading
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import lightning as L

from vlgs.files import write_atomically
from vlgs.gaussians import densify, remove, reset_opacity
from vlgs.gaussians.in_air import Air, narrow
from vlgs.runs import RunFolder, stop_signals
from vlgs.training.after_step import AfterStep, TrainedModule, own
from vlgs.training.checkpoint import save_checkpoint
from vlgs.training.curves import COLUMNS, csv_lines, read_rows
from vlgs.training.learner import Learner
from vlgs.training.lightning import VLGSModule
from vlgs.training.most_shown import most_shown
from vlgs.training.pixel_error import pixel_error
from vlgs.training.silence import silence
from vlgs.training.state import capture

log = logging.getLogger(__name__)


class Densification(AfterStep):
    """Clone, split, prune and reset, from the two real views of each iteration (conf/README.md, D.10 and D.11)."""

    full = False
    """Whether `gaussians.max_count` was told to have stopped growth."""

    def after_step(self, module: TrainedModule) -> None:
        """Gather the screen gradients of this iteration, then change the Gaussians when it is time."""
        assert isinstance(module, VLGSModule)
        densifying, done = module.densifying, module.next_step
        config = densifying.config
        last = done == module.settings.iterations
        if done == config.densify.stop and config.densify.prune_unseen > 0 and not last:
            gone = most_shown(module) < config.densify.prune_unseen
            remove(module.model.splats, module.optimizer, densifying.state, gone)
        if done >= config.densify.stop:
            return
        state, report = densifying.state, module.report
        size = config.densify.grad_threshold_size
        for camera, gradient, render in zip(
            report.cameras, report.screen_gradients, report.renders, strict=True
        ):
            state.accumulate(gradient, render.visible, camera.width, camera.height, size)
        if last:
            return  # no iteration would train what comes, or bring back what is made transparent
        if config.densify.densifies_at(done):
            judged = config.densify.by_error and "color" in module.step.needs
            did = densify(
                module.model.splats,
                module.optimizer,
                state,
                config,
                densifying.extent,
                module.seed,
                done,
                densifying.centers,
                module.model.attributes,
                pixel_error(module, report.step) if judged else None,
            )
            if did.refused and not self.full:
                self.full = True
                log.warning(
                    "iteration %d: gaussians.max_count=%d leaves no room for %d of the Gaussians that should be split or cloned;"
                    " raise it for finer detail",
                    done, config.max_count, did.refused,
                )  # fmt: skip
        if config.densify.resets_at(done):
            reset_opacity(module.model.splats, module.optimizer, config)


class Narrow(AfterStep):
    """As often as Gaussians may come and go, and after the last iteration, cut down those that reach a camera (`vlgs.gaussians.in_air.narrow`)."""

    def after_step(self, module: TrainedModule) -> None:
        """Do so when it is time, where scales are trained."""
        assert isinstance(module, VLGSModule)
        densifying, model, done = module.densifying, module.model, module.next_step
        config = densifying.config
        due = done % config.densify.every == 0 or done == module.settings.iterations
        if not due or config.max_angle == 0:
            return
        for name, values in model.splats.items():
            if model.attributes[name].role == "scale" and values.requires_grad:
                narrow(
                    values,
                    model.splats["means"],
                    densifying.centers,
                    config.max_angle,
                    model.raster.near,
                )


class ClearAir(AfterStep):
    """After the last iteration, remove what only language sees before a camera (`vlgs.gaussians.in_air`). Colour stays as it is."""

    def after_step(self, module: TrainedModule) -> None:
        """Do so when it is time, where positions were trained and Gaussians could come and go."""
        assert isinstance(module, VLGSModule)
        densifying, splats = module.densifying, module.model.splats
        done = module.next_step == module.settings.iterations
        if not done or not densifying.config.clear_air or densifying.config.densify.stop == 0:
            return
        opacities = splats["opacity_logits"].detach().sigmoid()
        gone = Air(module.views.scene)(splats["means"]) & (
            opacities < module.model.raster.alpha_min
        )
        remove(splats, module.optimizer, densifying.state, gone)


class Silence(AfterStep):
    """After the last iteration, take the codes of what lies outside of masks (`vlgs.training.silence`)."""

    def after_step(self, module: TrainedModule) -> None:
        """Do so when it is time."""
        assert isinstance(module, VLGSModule)
        share, features = module.densifying.config.silent_above, module.model.splats["features"]
        done = module.next_step == module.settings.iterations
        if done and share < 1 and module.views.has_language and features.requires_grad:
            silence(module, share)


class OwnFolder(AfterStep):
    """End a run whose folder was deleted or replaced, before anything more is written."""

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder

    def after_step(self, module: TrainedModule) -> None:
        """Check that the folder is still the same."""
        self.folder.require_own()


class Checkpoints(AfterStep):
    """Save every so many iterations, at the end and before an early stop; no step twice."""

    def __init__(self, folder: Path, every: int, meta: dict[str, Any]) -> None:
        self.folder = folder
        self.every = every
        self.meta = meta
        self.saved: int | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Note that the resumed step is saved already."""
        self.saved = own(pl_module).next_step

    def after_step(self, module: TrainedModule) -> None:
        """Save when it is time."""
        if self.every and module.next_step % self.every == 0:
            self._save(module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save what was reached."""
        self._save(own(pl_module))

    def _save(self, module: TrainedModule) -> None:
        if module.next_step != self.saved:
            state = module.capture if isinstance(module, Learner) else partial(capture, module)
            save_checkpoint(self.folder, state(self.meta))
            self.saved = module.next_step


class TrainingClock(AfterStep):
    """Seconds of training, summed over resumes; saving and evaluating are not part of it."""

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Start the clock of this iteration."""
        self.started = time.perf_counter()

    def after_step(self, module: TrainedModule) -> None:
        """Add this iteration and its densification."""
        module.train_seconds += time.perf_counter() - self.started


class CurveLog(AfterStep):
    """Append loss, PSNR and the number of Gaussians to log.csv and to the chosen Lightning loggers."""

    def __init__(self, path: Path, every: int) -> None:
        self.path = path
        self.every = every

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Keep the rows up to the resumed step; later ones will be written again."""
        step, rows = own(pl_module).next_step, []
        if self.path.is_file() and step > 0:
            rows = [row for row in read_rows(self.path) if int(row[0]) <= step]
        write_atomically(self.path, csv_lines([COLUMNS, *rows]).encode())

    def after_step(self, module: TrainedModule) -> None:
        """Write a row when it is time."""
        if module.next_step % self.every:
            return
        report = module.report
        row = {
            "loss": report.loss,
            "psnr": psnr_of(report.color_mse),
            "n_gaussians": module.count,
            "blend_weight": report.log.get("blend_weight", 0.0),
            "seconds": module.train_seconds,
        }
        cells = [module.next_step, *(f"{value:.6g}" for value in row.values())]
        with self.path.open("a", newline="") as file:
            deleted = file.tell() == 0  # by somebody, in mid-run: it goes on from here
            file.write(csv_lines([COLUMNS, cells] if deleted else [cells]))
        for logger in module.trainer.loggers:
            logger.log_metrics({k: float(v) for k, v in row.items()}, step=module.next_step)


class ProgressLine(AfterStep):
    """A progress bar with loss, PSNR, number of Gaussians and time left; redrawn at most four times a second."""

    def __init__(self) -> None:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
        )

        self.bar = Progress(
            BarColumn(bar_width=12),
            MofNCompleteColumn(),
            TextColumn(
                "loss {task.fields[loss]:.4f}  psnr {task.fields[psnr]:.2f} dB  {task.fields[count]}"
            ),
            TimeRemainingColumn(compact=True),
            TextColumn("left"),
            auto_refresh=False,
        )
        self.drawn = 0.0
        self.mse: float | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Show the bar."""
        module = own(pl_module)
        self.task = self.bar.add_task(
            "",
            total=module.settings.iterations,
            completed=module.next_step,
            loss=0.0,
            psnr=0.0,
            count=_gaussians(module.count),
        )
        with suppress(OSError):
            self.bar.start()

    def after_step(self, module: TrainedModule) -> None:
        """Redraw when a quarter of a second has passed."""
        report = module.report
        self.mse = (
            report.color_mse if self.mse is None else 0.95 * self.mse + 0.05 * report.color_mse
        )
        now = time.monotonic()
        if now - self.drawn < 0.25 and module.next_step < module.settings.iterations:
            return
        self.drawn = now
        self.bar.update(
            self.task,
            completed=module.next_step,
            loss=report.loss,
            psnr=psnr_of(self.mse),
            count=_gaussians(module.count),
        )
        with suppress(OSError):  # a closed terminal must not end a training
            self.bar.refresh()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leave the last state on the screen."""
        with suppress(OSError):
            self.bar.stop()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Give the terminal back."""
        with suppress(OSError):
            self.bar.stop()


class GracefulStop(L.Callback):
    """Ctrl-C, SIGTERM and a closed terminal end training after the current iteration, so that what is saved is a whole step.

    A second signal interrupts at once, but for a second hangup: shell and kernel may both send one.
    """

    def __init__(self) -> None:
        self.stopped_by: str | None = None
        self.previous: dict[int, Any] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take the signals over; only the main thread may."""

        def stop(number: int, frame: FrameType | None) -> None:
            self.stopped_by = signal.Signals(number).name
            trainer.should_stop = True
            again = signal.SIG_IGN if number == signal.SIGHUP else signal.default_int_handler
            signal.signal(number, again)
            _leave_closed_terminal(terminals)

        if threading.current_thread() is not threading.main_thread():
            return
        terminals = [descriptor for descriptor in (1, 2) if os.isatty(descriptor)]
        for number in stop_signals():
            self.previous[number] = signal.signal(number, stop)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Give the signals back."""
        self._release()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Give the signals back."""
        self._release()

    def _release(self) -> None:
        for number, handler in self.previous.items():
            signal.signal(number, handler)
        self.previous.clear()


def _leave_closed_terminal(terminals: list[int]) -> None:
    """Discard output to a closed terminal, so that an error of writing does not interrupt saving."""
    for descriptor in terminals:
        if not os.isatty(descriptor):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, descriptor)
            os.close(nowhere)


def _gaussians(count: int) -> str:
    return f"{count:,} Gaussians" if count else ""


def psnr_of(mse: float) -> float:
    """PSNR in dB of a mean squared error on [0, 1] images.

    Example:
        >>> psnr_of(0.01)
        20.0
    """
    return math.inf if mse == 0 else -10.0 * math.log10(mse)
