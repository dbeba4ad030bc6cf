"""Run folders: where the files of a run lie, and who may write them. Imports no torch.

    <results>/runs/<run id>/  config.yaml  metrics.json  queries.json  log.csv  checkpoint/  renders/  point_cloud.ply

`metrics.json` is written last: a folder that has it is a finished run.
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlgs.finished import read_finished

STOPPED = 130
"""Exit status after Ctrl-C, as shells have it."""

UNSCORED = 3
"""Exit status of a run whose scores were asked for and could not be computed: the run is there, its scores are null."""

BUSY = 75
"""Exit status where another process is computing this very run."""


@dataclass(frozen=True)
class RunFolder:
    """The folder of one run."""

    path: Path

    @property
    def config(self) -> Path:
        """Resolved configuration."""
        return self.path / "config.yaml"

    @property
    def metrics(self) -> Path:
        """Results; its presence says that the run is finished."""
        return self.path / "metrics.json"

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

    def finished(self) -> dict[str, Any] | None:
        """The results of a finished run.

        Raises:
            ValueError: If metrics.json is there but damaged; it says what to do.
        """
        return read_finished(self.metrics) if self.metrics.is_file() else None

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Hold the folder: a second process that wants it is refused. The lock dies with its process.

        Raises:
            BlockingIOError: If another process holds it.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        with (self.path / ".lock").open("a+") as file:
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
            yield
