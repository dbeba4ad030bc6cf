"""Train a scene, ask it questions, report: `python -m vlgs.run`. `--help` is the manual."""

import logging
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from vlgs.command import check_command
from vlgs.config import CONF, RESULTS_VERSION, identity, instantiate
from vlgs.prepare import Scenes, doubts, make_stages, prepare, text_encoder
from vlgs.runs import BUSY, STOPPED, UNSCORED, RunFolder

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(config: DictConfig) -> None:
    """One run; in a multirun Hydra calls this once per combination."""
    hydra_config = HydraConfig.get()
    basic = str(hydra_config.launcher._target_).endswith(".BasicLauncher")  # all in this process
    alone = basic or hydra_config.mode == RunMode.RUN
    alone = alone and "HYDRA_FULL_ERROR" not in os.environ
    try:
        status = run(config)
    except (ValueError, OSError, FloatingPointError) as error:
        if not alone:
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(BUSY if isinstance(error, BlockingIOError) else 1)
    except KeyboardInterrupt:  # while training it is a graceful stop, and never comes here
        if not alone:
            raise
        print("stopped; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(STOPPED)
    if status:
        sys.exit(status)


def command() -> None:
    """The command line, from reading it to the exit status."""
    try:
        check_command(sys.argv[1:])
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    main()


def run(config: DictConfig) -> int:
    """Do one run or take up one that was left; see `main`.

    Returns:
        The exit status: 0 when the results are there, else `STOPPED` or `UNSCORED`.
    """
    ready = prepare(config)
    folder = RunFolder(Path(config.results) / "runs" / ready.run_id)
    if config.on_existing == "refuse" and folder.path.is_dir():
        raise FileExistsError(
            f"run: {folder.path} must not exist with on_existing=refuse; on_existing=resume goes on with it"
        )
    with folder.writing(), _removed_if_refused(folder):
        return _run_in(folder, config, ready.scenes)


@contextmanager
def _removed_if_refused(folder: RunFolder) -> Iterator[None]:
    """Leave nothing of a run that is refused before its first iteration."""
    try:
        yield
    except (ValueError, OSError):
        begun = {".lock", folder.config.name}
        if all(path.name in begun for path in folder.path.iterdir()):
            for path in folder.path.iterdir():
                path.unlink()
            for path in (folder.path, *folder.path.parents[:2]):
                if not any(path.iterdir()):
                    path.rmdir()
        raise


def _run_in(folder: RunFolder, config: DictConfig, scenes: Scenes) -> int:
    finished = folder.finished()
    if finished is not None:
        log.info("this run exists: %s (nothing was computed)", folder.path)
        return _say(finished, folder)
    from vlgs.data.plausible import plausibility_warnings
    from vlgs.module.stages import StoppedError, train_all

    scene = next(reversed(scenes.values()))
    for doubt in (*doubts(config), *plausibility_warnings(scene, (*scene.train, *scene.test))):
        log.warning("warning: %s", doubt)
    text = text_encoder(config, scene)
    folder.config.write_text(OmegaConf.to_yaml(config, resolve=True))
    stages = make_stages(folder, config, scenes)
    try:
        sharing, augment = instantiate(config.sharing), instantiate(config.augment)
        models = train_all(stages, scenes, sharing, augment, joint=config.levels == "joint")
    except StoppedError as stop:
        log.warning("%s; the same command goes on from there:\n  %s", stop, _command())
        return STOPPED
    return _say(_report(folder, config, scenes, models, stages, text), folder)


def _say(metrics: dict[str, Any], folder: RunFolder) -> int:
    """Print a result; the exit status says whether it has the scores that were asked for."""
    from vlgs.report.summary import print_summary

    print_summary(metrics, _places(folder))
    return UNSCORED if metrics.get("failure") else 0


def _report(
    folder: RunFolder,
    config: DictConfig,
    scenes: Scenes,
    models: list[Any],
    stages: Any,
    text: Any,
) -> dict[str, Any]:
    """Everything that is said about trained models; metrics.json is written last and makes the run a finished one."""
    from vlgs.gaussians import write_ply
    from vlgs.module.stages import all_skips
    from vlgs.report.evaluate import evaluate, prompts_of
    from vlgs.report.pictures import write_pictures
    from vlgs.report.provenance import commit, machine
    from vlgs.report.results import write_metrics, write_queries
    from vlgs.report.timing import measure_fps

    model, scene = models[-1], next(reversed(scenes.values()))
    query, protocol = instantiate(config.query), instantiate(config.protocol)
    done, kept = stages.done.values(), stages.kept
    for stage in kept:
        write_ply(stage.folder.ply, stage.model.splats)
    evaluation = evaluate(models, scene, query, text, protocol)
    prompts, _ = prompts_of(scene, query, text)
    timing = measure_fps(model, [view.camera for view in scene.test or scene.train], query, prompts)
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
        "checkpoint_bytes": sum(_checkpoint_bytes(stage.folder) for stage in kept),
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
    write_queries(folder.queries, evaluation)
    return write_metrics(folder.metrics, evaluation, extra)


def _checkpoint_bytes(folder: RunFolder) -> int:
    return max(file.stat().st_size for file in folder.checkpoint.glob("*.safetensors"))


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
    return " ".join(["python -m vlgs.run", *overrides])


if __name__ == "__main__":
    command()
