"""One run in a process of its own: what every launcher calls, on whichever machine it puts it.

Jobs and the ablation exchange files in one folder, so that a worker on another machine needs only access to that folder. A job
writes its state to `<number>.json`, and stops early when a file named `stop` appears.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from vlgs.ablate.warm import WarmParent, WarmRun
from vlgs.config import override_value, quote_override
from vlgs.files import write_atomically
from vlgs.places import without_places
from vlgs.runs import BUSY, STOPPED, UNSCORED

TAIL_LINES = 5
POLL_SECONDS = 0.5
STOP = "stop"
RUN = (sys.executable, "-m", "vlgs.run")


@dataclass(frozen=True)
class JobOutcome:
    """How far one job is, or how it ended."""

    status: int | None = None
    """Exit status of `vlgs.run`, negative for the signal that killed it; None while it runs, or where its worker died."""
    seconds: float = 0.0
    """Wall time, start-up and evaluation included."""
    log: str = ""
    """File of everything that it wrote; empty where it was never started."""

    @property
    def done(self) -> bool:
        """Whether its results exist, with or without scores."""
        return self.status in (0, UNSCORED)

    @property
    def busy(self) -> bool:
        """Whether another process is computing it."""
        return self.status == BUSY

    @property
    def lost(self) -> bool:
        """Whether something outside of the run ended it, so that it should be tried again."""
        return self.status is None or self.status < 0 or self.status == STOPPED

    def reason(self) -> str:
        """Why it did not finish, with the last lines that it wrote."""
        path = Path(self.log)
        text = path.read_text(errors="replace") if self.log and path.is_file() else ""
        lines = [line for line in text.splitlines() if line.strip()][-TAIL_LINES:]
        how = f"exit status {self.status}"
        if self.status is None:
            how = "its worker died" if self.log else "it was never started"
        elif self.status < 0:
            how = f"killed by signal {-self.status}" + (
                " (out of memory?)" if self.status == -9 else ""
            )
        return "\n".join([how, *lines, *([f"log: {self.log}"] if self.log else [])])


def read_outcome(folder: Path, number: int) -> JobOutcome:
    """The last state that the job of that number wrote."""
    try:
        outcome = JobOutcome(**json.loads(_record(folder, number).read_text()))
    except FileNotFoundError:
        return JobOutcome()
    return replace(outcome, log=str(folder / outcome.log))


class StoppedJobs(BaseException):
    """The jobs that are left shall not be looked at."""


def run_job(config: DictConfig) -> None:
    """What a Hydra launcher calls: run the overrides of this job."""
    _run_job(warm=False)


def run_warm_job(config: DictConfig) -> None:
    """Likewise, on workers that are processes of this machine."""
    _run_job(warm=True)


def _run_job(warm: bool) -> None:
    hydra = HydraConfig.get()
    folder = Path(hydra.sweep.dir)
    run_and_record(folder, int(hydra.job.num), list(hydra.overrides.task), warm)
    if (folder / STOP).exists() and hydra.launcher._target_.endswith("BasicLauncher"):
        raise StoppedJobs  # it would compose one configuration after the other: half a minute for a hundred jobs


def run_and_record(folder: Path, number: int, overrides: Sequence[str], warm: bool = False) -> None:
    """Start `python -m vlgs.run` with these overrides and wait.

    A run that dies, by an error, a signal or want of memory, takes nothing with it: its log stays, and the others go on.

    Args:
        folder: Where job and launcher talk.
        number: Of the job, unique in that folder.
        overrides: Arguments of `vlgs.run`.
        warm: Whether to fork it from a parent that has imported all it needs (`vlgs.ablate.warm`).
    """
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"{number:04d}_{_title(overrides)}.log"
    arguments = [*map(_from_here, overrides), "progress=false"]
    start, stop = time.time(), folder / STOP

    def record(status: int | None) -> None:
        outcome = JobOutcome(status, time.time() - start, log.name)
        write_atomically(_record(folder, number), json.dumps(asdict(outcome)).encode())

    if stop.exists():
        record(STOPPED)
        return
    record(None)
    with log.open("w") as file:
        file.write(shlex.join(["python", "-m", "vlgs.run", *without_places(arguments)]) + "\n")
    run = _start_warm(arguments, log) if warm else None
    if run is not None:
        _wait(run, stop)
    if run is None or not run.begun:
        # Without a parent, or with one whose imports failed: the log says why, or all is well.
        run = _start_cold(arguments, log)
        _wait(run, stop)
    record(run.returncode)


_parents: list[WarmParent] = []
"""The warm parent of this process, once a job has asked for one."""


def leave_parent() -> None:
    """Let the warm parent of this process end, if there is one."""
    while _parents:
        _parents.pop().close()


def _start_warm(arguments: Sequence[str], log: Path) -> WarmRun | None:
    if _parents and not _parents[0].alive:
        leave_parent()
    if not _parents:
        _parents.append(WarmParent())
    return _parents[0].start(arguments, log)


def _start_cold(arguments: Sequence[str], log: Path) -> "subprocess.Popen[bytes]":
    with log.open("a") as file:
        # A session of its own: Ctrl-C in a terminal reaches it once, as the SIGTERM of `_wait`, and it saves its step.
        return subprocess.Popen(
            [*RUN, *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | {"COLUMNS": "120"},
            start_new_session=True,
        )


def _wait(run: "subprocess.Popen[bytes] | WarmRun", stop: Path) -> None:
    """Wait for the end of a run; tell it to save when the file `stop` appears."""
    told = False
    while True:
        try:
            run.wait(POLL_SECONDS)
            return
        except subprocess.TimeoutExpired:
            stopping = stop.exists()
        except KeyboardInterrupt:
            stopping = True
        if stopping and not told:
            run.terminate()
            told = True


def _from_here(override: str) -> str:
    """The results folder said from the current one where it lies below it, so that what the run prints names no home."""
    if not override.startswith("results="):
        return override
    place = Path(str(override_value(override)))
    below = place.is_absolute() and place.is_relative_to(Path.cwd())
    return quote_override("results", os.path.relpath(place)) if below else override


def _record(folder: Path, number: int) -> Path:
    return folder / f"{number:04d}.json"


def _title(overrides: Sequence[str]) -> str:
    """Name of the log: row, scene and seed, without paths and keys that move no number."""
    words = [o for o in overrides if not o.startswith(("results=", "hydra", "threads="))]
    name = "_".join(word.replace("data.", "").replace("/", "-") for word in words)
    safe = re.sub(r"[^\w=.,+@-]+", "_", name).encode()[-120:].decode(errors="ignore")
    return safe.lstrip("_.")  # what tells rows apart stands last
