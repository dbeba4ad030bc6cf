"""The table that is printed at the end of a multirun (`python -m vlgs.run -m ...`), for every launcher."""

import atexit
import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from vlgs.config import split_override
from vlgs.runs import UNSCORED, RunFolder
from vlgs.tables.runs import Run, compare

_ran: list[Path] = []
"""Folder of the current run of this process, set by `note_run`."""


def note_run(folder: Path) -> None:
    """Record the folder of this job's run, for the table."""
    _ran[:] = [folder]


class MultirunTable(Callback):
    """Hydra's hook: jobs leave a note each in a folder that goes with the hook to every worker, the end reads them."""

    def __init__(self) -> None:
        self.folder: Path | None = None

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Make the folder; the table comes also where an error or Ctrl-C ends the multirun."""
        name = f".notes-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"
        self.folder = Path(config.hydra.sweep.dir).resolve() / name
        self.folder.mkdir(parents=True, exist_ok=True)
        atexit.register(self._conclude)

    def on_job_start(self, config: DictConfig, **_: Any) -> None:
        """Note what is run."""
        _ran.clear()
        self._note(config, "stopped")

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """Note where it lies, or why it is not there."""
        state = ""
        if job_return.status == JobStatus.FAILED:
            error = job_return._return_value
            state = f"failed: {str(error).strip() or type(error).__name__}"
        self._note(config, state)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Print the table."""
        atexit.unregister(self._conclude)
        if self._conclude():
            sys.exit(UNSCORED)

    def _note(self, config: DictConfig, state: str) -> None:
        if self.folder is None or not self.folder.is_dir():
            return  # a single run
        number, chosen = int(config.hydra.job.num), list(config.hydra.overrides.task)
        note = {"run": str(_ran[0]) if _ran else "", "overrides": chosen, "state": state}
        (self.folder / f"{number:06d}.json").write_text(json.dumps(note))

    def _conclude(self) -> bool:
        """Print the table; whether some run has not the scores that were asked for."""
        if self.folder is None or not self.folder.is_dir():
            return False
        runs = []
        for file in sorted(self.folder.glob("*.json")):
            note = json.loads(file.read_text())
            path, metrics, state = Path(note["run"]), {}, note["state"].partition("\n")[0]
            if note["run"] and not state:
                metrics = RunFolder(path).finished() or {}
            options = dict(map(split_override, note["overrides"]))
            runs.append(Run(path if note["run"] else Path("--"), options, metrics, state[:120]))
        shutil.rmtree(self.folder, ignore_errors=True)
        if runs:
            print(f"{len(runs)} runs\n{compare(runs).text()}", flush=True)
        return any(run.metrics.get("failure") for run in runs)
