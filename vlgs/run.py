"""Train a scene, ask it questions, report: `python -m vlgs.run`. `--help` is the manual."""

import logging
import os
import resource
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from vlgs.arguments import command_line, take_command_line
from vlgs.config import (
    CONF,
    GIVEN_FILES,
    LEVELS,
    RESULTS_VERSION,
    check_config,
    identity,
    instantiate,
    run_id,
)
from vlgs.places import record, tidy_sweep, write_config
from vlgs.runs import BUSY, STOPPED, UNSCORED, RunFolder
from vlgs.tables.multirun import note_run
from vlgs.text import screen

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(config: DictConfig) -> None:
    """One run; in a multirun Hydra calls this once per combination."""
    alone = HydraConfig.get().mode == RunMode.RUN and "HYDRA_FULL_ERROR" not in os.environ
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        tidy_sweep(Path(HydraConfig.get().sweep.dir))
    try:
        status = run(config)
    except (ValueError, OSError, FloatingPointError) as error:
        if not alone:
            raise
        print(screen(f"error: {error}"), file=sys.stderr)
        sys.exit(BUSY if isinstance(error, BlockingIOError) else 1)
    except KeyboardInterrupt:  # while training it is a graceful stop, and never comes here
        if not alone:
            raise
        print("stopped; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(STOPPED)
    several = HydraConfig.get().mode == RunMode.MULTIRUN
    if status and not (several and status == UNSCORED):  # whose other runs go on
        sys.exit(status)


def run(config: DictConfig) -> int:
    """Do one run or take up one that was left; see `main`.

    Returns:
        The exit status: 0 when the results are there, else `STOPPED` or `UNSCORED`.
    """
    check_config(config)
    import torch

    from vlgs.interchange import file_digest

    torch.set_num_threads(config.threads)
    scenes = _scenes(config)
    given = {key: config[group].get(key) for group, key in GIVEN_FILES}
    augment = instantiate(config.augment)
    augment.require(scenes)
    read = [*(scene.fingerprint for scene in scenes.values()), augment.identity()]
    read += [file_digest(path, key) for key, path in given.items() if path]
    content = " ".join(filter(None, read))
    folder = RunFolder(Path(config.results) / "runs" / run_id(config, content))
    note_run(folder.path)
    if config.on_existing == "refuse" and folder.path.is_dir():
        raise FileExistsError(
            f"run: {folder.path} must not exist with on_existing=refuse; on_existing=resume goes on with it"
        )
    with folder.writing() as own:
        return _run_in(own, config, scenes)


def _scenes(config: DictConfig) -> dict[int | None, Any]:
    """Mask level -> scene; the last one, of whole objects where there are several, stands for what they share."""
    if config.levels == "single":
        return {config.data.get("level"): instantiate(config.data)}
    return {level: instantiate(config.data, level=level) for level in LEVELS}


def _run_in(folder: RunFolder, config: DictConfig, scenes: dict[int | None, Any]) -> int:
    finished = folder.finished()
    if finished is not None:
        return _say(finished, folder, "already done, nothing computed")
    from vlgs.module.stages import StoppedError, train_all

    text = _text_encoder(config, next(reversed(scenes.values())))
    write_config(folder.config, config)
    stages = _stages(folder, config, scenes)
    try:
        sharing, augment = instantiate(config.sharing), instantiate(config.augment)
        models = train_all(stages, scenes, sharing, augment, joint=config.levels == "joint")
    except StoppedError as stop:
        log.warning("%s; the same command goes on from there:\n  %s", stop, _command())
        return STOPPED
    return _say(_report(folder, config, scenes, models, stages, text), folder)


def _say(metrics: dict[str, Any], folder: RunFolder, first: str = "") -> int:
    """Print a result; the exit status says whether it has the scores that were asked for."""
    from vlgs.report.summary import print_summary

    print_summary(metrics, _places(folder), first=first)
    return UNSCORED if metrics.get("failure") else 0


def _text_encoder(config: DictConfig, scene: Any) -> Any:
    """What turns the scene's classes into vectors; None where nothing can be asked.

    A word that it does not know is an error now, not after training.
    """
    from vlgs.query import encode_questions, words_of
    from vlgs.query.text import VocabularyText

    if scene.mask_vectors.shape[0] == 0:
        return None
    text, query = instantiate(config.text)(vocabulary=scene.vocabulary), instantiate(config.query)
    if not words_of(scene, query):
        log.warning(
            "neither labels nor a vocabulary: language is trained but nothing can be asked (data.vocabulary=FILE, which "
            "`python -m vlgs.vocabulary words.txt FILE` makes)"
        )
        return None
    if isinstance(text, VocabularyText) and scene.vocabulary is None:
        log.warning(
            "no vocabulary: language is trained but not scored (data.vocabulary=FILE or text=clip)"
        )
        return None
    encode_questions(query, text, scene)
    return text


def _stages(folder: RunFolder, config: DictConfig, scenes: dict[int | None, Any]) -> Any:
    import torch

    from vlgs.module.build import Parts
    from vlgs.module.fit import FitOptions
    from vlgs.module.stages import Stages

    def make_parts() -> Parts:
        # Initial weights of the fusion come from the global generator; every other draw has one of its own.
        torch.manual_seed(config.seed)
        return Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})

    def make_options() -> FitOptions:
        meta = {
            "config": record(config),
            "fingerprint": " ".join(scene.fingerprint for scene in scenes.values()),
        }
        loggers = [instantiate(logger) for logger in config.logger.loggers]
        return FitOptions(meta=meta, progress=config.progress, loggers=loggers)

    return Stages(folder, make_parts, make_options, config.seed)


def _report(
    folder: RunFolder,
    config: DictConfig,
    scenes: dict[int | None, Any],
    models: list[Any],
    stages: Any,
    text: Any,
) -> dict[str, Any]:
    """Everything that is said about trained models; metrics.json is written last and makes the run a finished one."""
    from vlgs.gaussians import write_ply
    from vlgs.module.stages import all_skips
    from vlgs.render.cloud import point_cloud
    from vlgs.report.evaluate import evaluate
    from vlgs.report.pictures import write_pictures
    from vlgs.report.provenance import commit, machine
    from vlgs.report.results import write_metrics, write_queries
    from vlgs.report.timing import measure_fps
    from vlgs.report.words import questions_of

    model, scene = models[-1], next(reversed(scenes.values()))
    query, protocol = instantiate(config.query), instantiate(config.protocol)
    done, kept = stages.done.values(), stages.kept
    folder.require_own()
    for stage in kept:
        cloud = point_cloud(stage.model, [view.camera for view in scene.train], stage.color)
        write_ply(stage.folder.ply, cloud.params, notes=cloud.notes)
    evaluation = evaluate(models, scene, query, text, protocol)
    asked = questions_of(model, scene, query, text)
    prompts = asked.prompts if asked else None
    if asked and asked.note:
        query = asked.query
        evaluation = replace(evaluation, reasons={**evaluation.reasons, "words": asked.note})
    cameras, language = [v.camera for v in scene.test or scene.train], len(scene.mask_vectors) > 0
    timing = measure_fps(model, cameras, query, prompts, language)
    if config.pictures:
        write_pictures(folder.renders, model, scene, query, prompts)
    extra = {
        "n_gaussians": sum(stage.model.count for stage in kept),
        "levels": [level for level in scenes if level is not None]
        if len(scene.mask_vectors)
        else [],
        "level_models": config.levels,
        "train_seconds": sum(stage.seconds for stage in done),
        "skips": all_skips(done).report(),
        "peak_rss_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "ply_bytes": sum(stage.folder.ply.stat().st_size for stage in kept),
        "checkpoint_bytes": sum(stage.checkpoint_bytes for stage in kept),
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
    """What the summary points at."""
    places = {"run": folder.path, "pictures": folder.renders / "overview.png", "model": folder.ply}
    return {name: path for name, path in places.items() if path.exists()}


def _dataset(config: DictConfig) -> str:
    """Option of conf/data; where nobody chose one on a command line, the module that reads it."""
    if HydraConfig.initialized():
        return str(HydraConfig.get().runtime.choices["data"])
    return str(config.data._target_).split(".")[-2]


def _command() -> str:
    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    return command_line("vlgs.run", overrides)


if __name__ == "__main__":
    take_command_line()
    main()
