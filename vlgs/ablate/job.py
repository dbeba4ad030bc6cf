"""One run in a process of its own: what every launcher calls, on whichever machine it puts it."""

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from vlgs.runs import BUSY, STOPPED, UNSCORED

TAIL_LINES = 5


@dataclass(frozen=True)
class Outcome:
    """How one run ended."""

    name: str
    status: int
    """Exit status of `vlgs.run`; negative for the signal that killed it."""
    seconds: float
    log: Path

    @property
    def done(self) -> bool:
        """Whether its results are there, if without the scores that were asked for."""
        return self.status in (0, UNSCORED)

    @property
    def busy(self) -> bool:
        """Whether another process is computing it."""
        return self.status == BUSY

    @property
    def stopped(self) -> bool:
        """Whether it was interrupted and saved."""
        return self.status == STOPPED

    def tail(self) -> str:
        """The last lines that it wrote."""
        lines = self.log.read_text(errors="replace").splitlines() if self.log.is_file() else []
        return "\n".join(line for line in lines if line.strip())[-2000:].rsplit("\n", TAIL_LINES)[
            -1
        ]


def run_job(config: DictConfig) -> Outcome:
    """Start `python -m vlgs.run` with the overrides of this job, and wait.

    A run that dies, by an error, a signal or want of memory, takes nothing with it: its log stays, and the others go on.
    """
    overrides = list(HydraConfig.get().overrides.task)
    log = log_path(Path(config.results), overrides)
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "vlgs.run", *overrides, "progress=false"]
    start = time.perf_counter()
    with log.open("w") as file:
        file.write(" ".join(command) + "\n")
        file.flush()
        with subprocess.Popen(
            command, stdout=file, stderr=subprocess.STDOUT, env=os.environ | {"COLUMNS": "120"}
        ) as process:
            try:
                status = process.wait()
            except KeyboardInterrupt:
                process.terminate()  # it ends its step and saves it; a Ctrl-C from the terminal reached it already
                process.wait()
                raise
    return Outcome(log.stem, status, time.perf_counter() - start, log)


def log_path(results: Path, overrides: list[str]) -> Path:
    """Where a run of these overrides logs."""
    words = [o for o in overrides if not o.startswith(("results=", "hydra", "threads="))]
    name = "_".join(word.replace("data.", "").replace("/", "-") for word in words)
    return results / "logs" / f"{name[:200]}.log"
