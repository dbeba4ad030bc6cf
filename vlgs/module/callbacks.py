"""What happens around an iteration: densification, checkpoints, the progress bar, log.csv, a graceful stop."""

import csv
import math
import signal
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

import lightning as L

from vlgs.gaussians import densify, reset_opacity
from vlgs.module.checkpoint import save_checkpoint
from vlgs.module.lightning import VLGSModule
from vlgs.module.state import capture


class Densification(L.Callback):
    """Clone, split, prune and reset, from the two real views of each iteration (systems.md A.1, D.10, D.11)."""

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Gather the screen gradients of this iteration, then change the Gaussians when it is time."""
        module = _own(pl_module)
        config, done = module.gaussians_config, module.next_step
        if done >= config.densify.stop:
            return
        state, views = module.densify_state, module.sampler.pair(done - 1)
        for index, gradient, render in zip(
            views, module.screen_gradients, module.report.renders, strict=True
        ):
            camera = module.scene.train[index].camera
            state.accumulate(gradient, render.visible, camera.width, camera.height)
        if config.densify.densifies_at(done):
            densify(
                module.model.splats,
                module.optimizer,
                state,
                config,
                module.extent,
                module.seed,
                done,
                module.centers,
            )
        if config.densify.resets_at(done):
            reset_opacity(module.model.splats, module.optimizer, config)


class Checkpoints(L.Callback):
    """Save every so many iterations, at the end and before an early stop."""

    def __init__(self, folder: Path, every: int, meta: dict[str, Any]) -> None:
        self.folder = folder
        self.every = every
        self.meta = meta

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Save when it is time; the last iteration is saved by `on_train_end`."""
        module = _own(pl_module)
        if self.every and module.next_step % self.every == 0:
            self._save(module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save what was reached."""
        self._save(_own(pl_module))

    def _save(self, module: VLGSModule) -> None:
        save_checkpoint(self.folder, capture(module, self.meta))


class TrainingClock(L.Callback):
    """Seconds of training, summed over resumes; saving and evaluating are not part of it."""

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Start the clock of this iteration."""
        self.started = time.perf_counter()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Add this iteration and its densification."""
        _own(pl_module).train_seconds += time.perf_counter() - self.started


class CurveLog(L.Callback):
    """Append loss, PSNR and the number of Gaussians to log.csv and to the chosen Lightning loggers."""

    COLUMNS = ("step", "loss", "psnr", "n_gaussians", "blend_weight", "seconds")

    def __init__(self, path: Path, every: int) -> None:
        self.path = path
        self.every = every

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Keep the rows up to the step that is resumed from; later ones will come again."""
        module = _own(pl_module)
        rows: list[list[str]] = []
        if self.path.is_file() and module.next_step > 0:
            with self.path.open(newline="") as file:
                rows = [
                    row for row in list(csv.reader(file))[1:] if int(row[0]) <= module.next_step
                ]
        with self.path.open("w", newline="") as file:
            csv.writer(file).writerows([list(self.COLUMNS), *rows])

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Write a row when it is time."""
        module = _own(pl_module)
        if module.next_step % self.every:
            return
        report = module.report
        row = {
            "loss": report.loss,
            "psnr": psnr_of(report.color_mse),
            "n_gaussians": module.model.count,
            "blend_weight": report.blend_weight,
            "seconds": module.train_seconds,
        }
        with self.path.open("a", newline="") as file:
            csv.writer(file).writerow(
                [module.next_step, *(f"{value:.6g}" for value in row.values())]
            )
        for logger in trainer.loggers:
            logger.log_metrics({k: float(v) for k, v in row.items()}, step=module.next_step)


class ProgressLine(L.Callback):
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
                "loss {task.fields[loss]:.4f}  psnr {task.fields[psnr]:.2f} dB  {task.fields[count]:,} Gaussians"
            ),
            TimeRemainingColumn(compact=True),
            TextColumn("left"),
            auto_refresh=False,
        )
        self.drawn = 0.0
        self.mse: float | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Show the bar."""
        module = _own(pl_module)
        self.task = self.bar.add_task(
            "",
            total=module.settings.iterations,
            completed=module.next_step,
            loss=0.0,
            psnr=0.0,
            count=module.model.count,
        )
        self.bar.start()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Redraw when a quarter of a second has passed."""
        module = _own(pl_module)
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
            count=module.model.count,
        )
        self.bar.refresh()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leave the last state on the screen."""
        self.bar.stop()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Give the terminal back."""
        self.bar.stop()


class GracefulStop(L.Callback):
    """Ctrl-C and SIGTERM end training after the current iteration, so that what is saved is a whole step.

    A second signal interrupts at once.
    """

    def __init__(self) -> None:
        self.stopped_by: str | None = None
        self.previous: dict[int, Any] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take the signals over; only the main thread may."""

        def stop(number: int, frame: FrameType | None) -> None:
            self.stopped_by = signal.Signals(number).name
            trainer.should_stop = True
            signal.signal(number, signal.default_int_handler)

        if threading.current_thread() is not threading.main_thread():
            return
        for number in (signal.SIGINT, signal.SIGTERM):
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


def psnr_of(mse: float) -> float:
    """PSNR in dB of a mean squared error on [0, 1] images.

    Example:
        >>> psnr_of(0.01)
        20.0
    """
    return math.inf if mse == 0 else -10.0 * math.log10(mse)


def _own(module: L.LightningModule) -> VLGSModule:
    assert isinstance(module, VLGSModule)
    return module
