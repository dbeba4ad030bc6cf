"""Train a scene, ask it questions, report: `python -m vlgs.run`. `--help` is the manual."""

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from vlgs.arguments import command_line, take_command_line
from vlgs.command import check_command
from vlgs.config import CONF, check_config
from vlgs.imports import uncollected
from vlgs.places import tidy_sweep, write_config
from vlgs.runs import BUSY, STOPPED, UNSCORED, RunFolder
from vlgs.tables.multirun import note_run
from vlgs.task import run_task
from vlgs.text import screen

if TYPE_CHECKING:
    from vlgs.prepare import Prepared

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(config: DictConfig) -> None:
    """One run; in a multirun Hydra calls this once per combination."""
    several = HydraConfig.get().mode == RunMode.MULTIRUN
    if several:
        tidy_sweep(Path(HydraConfig.get().sweep.dir))
    # In a multirun Hydra notes an error and goes on with the other runs; `command` says the first when all are done.
    with nullcontext() if several else _errors_in_a_line():
        try:
            status = run(config)
        finally:
            if several:
                with suppress(OSError):  # somebody put something there, or Hydra made none
                    Path(HydraConfig.get().runtime.output_dir).rmdir()
    if status and not (several and status == UNSCORED):  # whose other runs go on
        sys.exit(status)


def command() -> None:
    """The command line, from reading it to the exit status."""
    with _errors_in_a_line():
        take_command_line()
        composed = check_command(sys.argv[1:])
        if composed is not None:
            run_task(main, composed)
            return
        several = {"-m", "--multirun"} & set(sys.argv)
        with _whole_errors() if several else nullcontext():
            main()


@contextmanager
def _whole_errors() -> Iterator[None]:
    """Make Hydra raise the error of a multirun; by itself it would print half of a traceback and exit."""
    before = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        del os.environ["HYDRA_FULL_ERROR"]
        if before is not None:
            os.environ["HYDRA_FULL_ERROR"] = before


@contextmanager
def _errors_in_a_line() -> Iterator[None]:
    """End the process with what is wrong, unless HYDRA_FULL_ERROR asks for the traceback."""
    in_full = "HYDRA_FULL_ERROR" in os.environ
    try:
        yield
    except (ValueError, OSError, FloatingPointError) as error:
        if in_full:
            raise
        print(screen(f"error: {error}"), file=sys.stderr)
        sys.exit(BUSY if isinstance(error, BlockingIOError) else 1)
    except KeyboardInterrupt:  # while training it is a graceful stop, and never comes here
        if in_full:
            raise
        print("stopped; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(STOPPED)


def run(config: DictConfig) -> int:
    """Do one run, or continue one that was interrupted; see `main`.

    Returns:
        The exit status: 0 when the results are there, else `STOPPED` or `UNSCORED`.
    """
    check_config(config)
    with uncollected():
        from vlgs.experiment import construct
        from vlgs.prepare import prepare

    ready = prepare(construct(config))
    folder = RunFolder(ready.experiment.results / "runs" / ready.run_id)
    note_run(folder.path)
    if ready.experiment.refuse_existing and folder.path.is_dir():
        raise FileExistsError(
            f"run: {folder.path} must not exist with on_existing=refuse; on_existing=resume goes on with it"
        )
    with folder.writing() as own, _removed_if_refused(folder):
        return _run_in(own, ready)


@contextmanager
def _removed_if_refused(folder: RunFolder) -> Iterator[None]:
    """Remove the folder of a run that is refused before its first iteration."""
    try:
        yield
    except (ValueError, OSError, FloatingPointError):
        begun = {".lock", folder.config.name, folder.scene.name}
        if folder.curves.is_file() and folder.curves.read_bytes().count(b"\n") <= 1:
            begun.add(folder.curves.name)  # the heads of its columns alone
        if folder.path.is_dir() and all(path.name in begun for path in folder.path.iterdir()):
            for path in folder.path.iterdir():
                path.unlink()
            for path in (folder.path, *folder.path.parents[:2]):
                if not any(path.iterdir()):
                    path.rmdir()
        raise


def _run_in(folder: RunFolder, ready: "Prepared") -> int:
    finished = folder.finished()
    if finished is not None:
        return _say(finished, folder, _already_done(folder, ready))
    from vlgs.data.scene_warnings import plausibility_warnings
    from vlgs.finish import report
    from vlgs.opened.files import write_scene
    from vlgs.prepare import doubts, make_workshop, text_encoder
    from vlgs.trained_before import take_training
    from vlgs.training.stages import run_stages
    from vlgs.training.workshop import StoppedError

    experiment, scene = ready.experiment, ready.scene
    views = (*scene.train, *scene.test)
    for doubt in (*doubts(experiment), *plausibility_warnings(scene, views)):
        log.warning("warning: %s", doubt)
    text = text_encoder(experiment, scene)
    write_config(folder.config, experiment.record)
    write_scene(folder, scene, list(ready.scenes))
    taken = take_training(folder, ready.trained_id)
    workshop = make_workshop(folder, ready)
    try:
        progress = run_stages(experiment.stages(), ready.scenes, workshop)
    except StoppedError as stop:
        log.warning("%s; the same command goes on from there:\n  %s", stop, _command())
        return STOPPED
    return _say(report(ready, progress, workshop, text, taken or {}), folder)


def _already_done(folder: RunFolder, ready: "Prepared") -> str:
    """What is said of a finished run; its pictures are drawn if it was told to have none then, and is to have them now."""
    from vlgs.finish import draw_missing

    if draw_missing(ready, folder):
        return "already done; its pictures were drawn now, nothing else computed"
    return "already done, nothing computed"


def _say(metrics: dict[str, Any], folder: RunFolder, first: str = "") -> int:
    """Print a result; the exit status says whether it has the scores that were asked for."""
    from vlgs.report.summary import print_summary

    print_summary(metrics, _places(folder), first=first)
    return UNSCORED if metrics.get("failure") else 0


def _places(folder: RunFolder) -> dict[str, Path]:
    """Files that the summary lists, as far as they exist."""
    places = {"run": folder.path, "pictures": folder.renders / "overview.png", "model": folder.ply}
    return {name: path for name, path in places.items() if path.exists()}


def _command() -> str:
    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    return command_line("vlgs.run", overrides)


if __name__ == "__main__":
    command()
