"""Commands of the project as a function: what the families and their tests do to the command line. No family itself."""

import contextlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hydra.core.global_hydra import GlobalHydra

# Imported here, that children need not: nothing of it computes.
from vlgs import check, run

COMMANDS = {"check": check.command, "run": run.command}

TINY = (
    *("data.width=24", "data.height=18", "data.train_views=3", "data.test_views=1"),
    *("data.points=60", "data.cache=null", "head.cache_dir=null", "head.training.steps=2"),
    *("trainer=smoke", "trainer.iterations=2", "progress=false", "pictures=false", "threads=1"),
)
"""A procedural scene and a run of two steps: a second."""


@dataclass(frozen=True)
class Said:
    """How a command ended."""

    status: int
    text: str

    @property
    def error(self) -> str:
        """The one line that a refused run ends with."""
        lines = [line for line in self.text.splitlines() if line.startswith("error: ")]
        return lines[-1].removeprefix("error: ") if lines else ""


def command(name: str, arguments: Sequence[str]) -> Said:
    """Do `python -m vlgs.<name> <arguments>` in this process.

    Raises:
        BaseException: Whatever the command does not turn into an exit status.
    """
    GlobalHydra.instance().clear()
    sys.argv = [f"vlgs.{name}", *arguments]
    told, status = io.StringIO(), 0
    loader = logging.getLogger("vlgs.data.colmap")
    level = loader.level
    with _captured(told):
        try:
            COMMANDS[name]()
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else int(bool(stop.code))
            if isinstance(stop.code, str):
                told.write(f"{stop.code}\n")
        finally:
            loader.setLevel(level)  # check lowers it for its process
    return Said(status, told.getvalue())


def both(arguments: Sequence[str], results: Path) -> tuple[Said, Said]:
    """Check, then run; they must say the same, and what is refused must leave no run.

    Raises:
        AssertionError: If they do not, or it does.
    """
    place = [f"results={results}"] * (not any("results=" in given for given in arguments))
    checked, ran = (command(name, [*arguments, *place]) for name in ("check", "run"))
    refused = ran.status not in (0, 3)
    assert (checked.status != 0) == refused, f"check: {checked}; run: {ran}"
    if refused:
        assert ran.error, f"run ends with {ran.status} and no line: {ran.text}"
        first = ran.error.partition(" (and ")[0]  # check lists the others
        assert first in checked.text, f"check: {checked.text}; run: {ran.error}"
        assert not list(results.glob("runs/*")), f"left {list(results.glob('runs/*'))}"
    return checked, ran


def outcome(arguments: Sequence[str], folder: Path) -> None:
    """`both`, as an attack: a refusal is raised, anything else passes."""
    folder.mkdir()
    os.chdir(folder)
    _, ran = both(arguments, folder / "results")
    if ran.status not in (0, 3):
        raise ValueError(ran.error)


@contextlib.contextmanager
def _captured(told: io.StringIO) -> Iterator[None]:
    quiet = warnings.catch_warnings(action="ignore")
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told), quiet:
        yield
    for handler in logging.getLogger().handlers[:]:
        logging.getLogger().removeHandler(handler)
