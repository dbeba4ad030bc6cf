"""Train a scene, ask it questions, report: `python -m vlgs.run`. `--help` is the manual."""

import logging
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from vlgs.arguments import command_line, take_command_line
from vlgs.command import check_command
from vlgs.config import CONF, instantiate
from vlgs.identity import RESULTS_VERSION, identity
from vlgs.places import tidy_sweep, write_config
from vlgs.prepare import Scenes, doubts, make_workshop, prepare, stage_options, text_encoder
from vlgs.runs import BUSY, STOPPED, UNSCORED, RunFolder
from vlgs.tables.multirun import note_run
from vlgs.text import screen

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(config: DictConfig) -> None:
    """One run; in a multirun Hydra calls this once per combination."""
    several = HydraConfig.get().mode == RunMode.MULTIRUN
    if several:
        tidy_sweep(Path(HydraConfig.get().sweep.dir))
    # In a multirun Hydra notes an error and goes on with the other runs; `command` says the first when all are done.
    with nullcontext() if several else _errors_in_a_line():
        status = run(config)
    if status and not (several and status == UNSCORED):  # whose other runs go on
        sys.exit(status)


def command() -> None:
    """The command line, from reading it to the exit status."""
    with _errors_in_a_line():
        take_command_line()
        check_command(sys.argv[1:])
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
    ready = prepare(config)
    folder = RunFolder(Path(config.results) / "runs" / ready.run_id)
    note_run(folder.path)
    if config.on_existing == "refuse" and folder.path.is_dir():
        raise FileExistsError(
            f"run: {folder.path} must not exist with on_existing=refuse; on_existing=resume goes on with it"
        )
    with folder.writing() as own, _removed_if_refused(folder):
        return _run_in(own, config, ready.scenes)


@contextmanager
def _removed_if_refused(folder: RunFolder) -> Iterator[None]:
    """Remove the folder of a run that is refused before its first iteration."""
    try:
        yield
    except (ValueError, OSError, FloatingPointError):
        begun = {".lock", folder.config.name}
        if folder.curves.is_file() and folder.curves.read_bytes().count(b"\n") <= 1:
            begun.add(folder.curves.name)  # the heads of its columns alone
        if folder.path.is_dir() and all(path.name in begun for path in folder.path.iterdir()):
            for path in folder.path.iterdir():
                path.unlink()
            for path in (folder.path, *folder.path.parents[:2]):
                if not any(path.iterdir()):
                    path.rmdir()
        raise


def _run_in(folder: RunFolder, config: DictConfig, scenes: Scenes) -> int:
    finished = folder.finished()
    if finished is not None:
        return _say(finished, folder, "already done, nothing computed")
    from vlgs.data.plausible import plausibility_warnings
    from vlgs.module.stages import run_stages
    from vlgs.module.workshop import StoppedError

    scene = next(reversed(scenes.values()))
    for doubt in (*doubts(config), *plausibility_warnings(scene, (*scene.train, *scene.test))):
        log.warning("warning: %s", doubt)
    text = text_encoder(config, scene)
    write_config(folder.config, config)
    workshop = make_workshop(folder, config, scenes)
    try:
        progress = run_stages(stage_options(config), scenes, workshop)
    except StoppedError as stop:
        log.warning("%s; the same command goes on from there:\n  %s", stop, _command())
        return STOPPED
    return _say(_report(folder, config, scenes, progress, workshop, text), folder)


def _say(metrics: dict[str, Any], folder: RunFolder, first: str = "") -> int:
    """Print a result; the exit status says whether it has the scores that were asked for."""
    from vlgs.report.summary import print_summary

    print_summary(metrics, _places(folder), first=first)
    return UNSCORED if metrics.get("failure") else 0


def _report(
    folder: RunFolder,
    config: DictConfig,
    scenes: Scenes,
    progress: Any,
    workshop: Any,
    text: Any,
) -> dict[str, Any]:
    """Evaluate the trained scene and write scores, pictures and point clouds. metrics.json is written last: it marks the run as finished."""
    from vlgs.fields.cloud import write_point_cloud
    from vlgs.module.workshop import all_skips
    from vlgs.report.evaluate import evaluate
    from vlgs.report.pictures import write_pictures
    from vlgs.report.provenance import commit, machine
    from vlgs.report.results import write_metrics, write_queries
    from vlgs.report.timing import measure_fps
    from vlgs.report.words import questions_of

    field, scene = progress.field(), next(reversed(scenes.values()))
    query, protocol = instantiate(config.query), instantiate(config.protocol)
    done, kept = workshop.made.values(), workshop.kept
    folder.require_own()
    trained_on = [view.camera for view in scene.train]
    written = [
        made.folder.ply
        for made in kept
        if write_point_cloud(made.folder.ply, made.field, trained_on)
    ]
    evaluation = evaluate(field, scene, query, text, protocol)
    asked = questions_of(field, scene, query, text)
    prompts = asked.prompts if asked else None
    if asked and asked.note:
        query = asked.query
        evaluation = replace(evaluation, reasons={**evaluation.reasons, "words": asked.note})
    if len(progress.scenes) > 1:
        first, *_, last = scenes
        whose = f"of the model of mask level {last}, as are frame rates; psnr and ssim of that of {first}"
        evaluation = replace(evaluation, reasons={**evaluation.reasons, "pictures": whose})
    cameras, language = [v.camera for v in scene.test or scene.train], len(scene.mask_vectors) > 0
    timing = measure_fps(field, cameras, query, prompts, language)
    if config.pictures:
        write_pictures(folder.renders, field, scene, query, prompts)
    extra = {
        "n_gaussians": sum(made.gaussians for made in kept),
        "levels": [level for level in scenes if level is not None]
        if len(scene.mask_vectors)
        else [],
        "level_models": config.levels,
        "train_seconds": sum(made.seconds for made in done),
        "skips": all_skips(done).report(),
        "peak_rss_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "ply_bytes": sum(path.stat().st_size for path in written) if written else None,
        "checkpoint_bytes": sum(made.checkpoint_bytes for made in kept),
        "seed": config.seed,
        "config_hash": folder.path.name,
        "recipe": identity(config).recipe,
        "data_recipe": identity(config).data,
        "dataset": _dataset(config),
        "scene": scene.name,
        "fingerprint": scene.fingerprint,
        "results_version": RESULTS_VERSION,
        "commit": commit(),
        "machine": machine(),
        **asdict(timing),
    }
    folder.require_own()
    write_queries(folder.queries, evaluation)
    return write_metrics(folder.metrics, evaluation, extra)


def _places(folder: RunFolder) -> dict[str, Path]:
    """Files that the summary lists, as far as they exist."""
    places = {"run": folder.path, "pictures": folder.renders / "overview.png", "model": folder.ply}
    return {name: path for name, path in places.items() if path.exists()}


def _dataset(config: DictConfig) -> str:
    """The chosen option of conf/data; without a command line, the name of the module that reads the scene."""
    if HydraConfig.initialized():
        return str(HydraConfig.get().runtime.choices["data"])
    return str(config.data._target_).split(".")[-2]


def _command() -> str:
    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    return command_line("vlgs.run", overrides)


if __name__ == "__main__":
    command()
