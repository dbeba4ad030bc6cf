"""Run folders: where the files of a run are, and the lock that lets one process write them. Imports no torch.

    <results>/runs/<run id>/  config.yaml  scene.safetensors  log.csv  checkpoint/
                              metrics.json  queries.json  renders/  point_cloud.ply  field.safetensors

`metrics.json` is written last: a folder that has it is a finished run.
"""

import fcntl
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vlgs.files import sweep_below
from vlgs.finished import read_finished

STOPPED = 130
"""Exit status after Ctrl-C, as shells have it."""

UNSCORED = 3
"""Exit status of a run whose scores were asked for and could not be computed: the run is there, its scores are null."""

BUSY = 75
"""Exit status where another process is computing this very run."""


def stop_signals() -> tuple[signal.Signals, ...]:
    """Signals that ask a run to save and stop; a closed terminal's is left alone where it is ignored, as under nohup."""
    hangup = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
    return (signal.SIGINT, signal.SIGTERM, *hangup)


@dataclass(frozen=True)
class Lock:
    """A lock file that this process holds."""

    path: Path
    descriptor: int

    def holds(self) -> bool:
        """Whether the file is still in its place: once it is deleted, another process can make and hold one of its own."""
        try:
            there = self.path.stat()
        except FileNotFoundError:
            return False
        return os.path.samestat(there, os.fstat(self.descriptor))


@dataclass(frozen=True)
class RunFolder:
    """The folder of one run, or of one model of a run that trains several."""

    path: Path
    lock: Lock | None = None
    """Of the run, where this process is writing it."""

    @property
    def config(self) -> Path:
        """Resolved configuration."""
        return self.path / "config.yaml"

    @property
    def metrics(self) -> Path:
        """Results; its presence says that the run is finished."""
        return self.path / "metrics.json"

    @property
    def scene(self) -> Path:
        """Cameras and words of the scene, from the start of the run (`vlgs.opened.files`)."""
        return self.path / "scene.safetensors"

    @property
    def field(self) -> Path:
        """The trained scene, from its end."""
        return self.path / "field.safetensors"

    @property
    def queries(self) -> Path:
        """The score of every query: one row per protocol, view and category."""
        return self.path / "queries.json"

    @property
    def curves(self) -> Path:
        """Loss, PSNR and number of Gaussians over the iterations."""
        return self.path / "log.csv"

    @property
    def checkpoint(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoint"

    @property
    def renders(self) -> Path:
        """Folder of the pictures."""
        return self.path / "renders"

    @property
    def ply(self) -> Path:
        """Gaussians as other viewers draw them: after fusion."""
        return self.path / "point_cloud.ply"

    def part(self, name: str) -> "RunFolder":
        """The folder of one model of this run; an empty name is this folder."""
        return replace(self, path=self.path / name)

    def require_own(self) -> None:
        """Do nothing if the folder is still the one that was opened for writing.

        Raises:
            FileNotFoundError: If somebody has deleted or moved it, or made it again.
        """
        if self.lock is not None and not self.lock.holds():
            raise FileNotFoundError(
                f"run: {self.lock.path.parent} must stay in its place while the run writes to it, got it deleted, moved or "
                "replaced; the same command runs again, from the last checkpoint if there still is one"
            )

    def finished(self) -> dict[str, Any] | None:
        """The results of a finished run.

        Raises:
            ValueError: If metrics.json is there but damaged; it says what to do.
        """
        return read_finished(self.metrics) if self.metrics.is_file() else None

    @contextmanager
    def writing(self) -> Iterator["RunFolder"]:
        """Hold the folder: a second process that wants it is refused. The lock dies with its process.

        What killed processes left half-written in it is removed.

        Raises:
            BlockingIOError: If another process holds it.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        path = self.path / ".lock"
        with path.open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                file.seek(0)
                holder = file.read().strip() or "unknown"
                raise BlockingIOError(
                    f"run: {self.path} must not be in use, got process {holder} writing to it"
                ) from error
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
            sweep_below(self.path)
            yield replace(self, lock=Lock(path, file.fileno()))
