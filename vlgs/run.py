"""Train a scene, ask it questions, report: `python -m vlgs.run`. `--help` is the manual."""

import logging
import os
import resource
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from vlgs.config import (
    CONF,
    GIVEN_FILES,
    RESULTS_VERSION,
    check_config,
    identity,
    instantiate,
    run_id,
)
from vlgs.runs import BUSY, STOPPED, UNSCORED, RunFolder

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(config: DictConfig) -> None:
    """One run; in a multirun Hydra calls this once per combination."""
    alone = HydraConfig.get().mode == RunMode.RUN and "HYDRA_FULL_ERROR" not in os.environ
    try:
        status = run(config)
    except (ValueError, OSError, FloatingPointError) as error:
        if not alone:
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(BUSY if isinstance(error, BlockingIOError) else 1)
    if status:
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
    scene = instantiate(config.data)
    given = {key: config[group].get(key) for group, key in GIVEN_FILES}
    content = " ".join([scene.fingerprint, *(file_digest(p, k) for k, p in given.items() if p)])
    folder = RunFolder(Path(config.results) / "runs" / run_id(config, content))
    if config.on_existing == "refuse" and folder.path.is_dir():
        raise FileExistsError(
            f"run: {folder.path} must not exist with on_existing=refuse; on_existing=resume goes on with it"
        )
    with folder.writing():
        return _run_in(folder, config, scene)


def _run_in(folder: RunFolder, config: DictConfig, scene: Any) -> int:
    finished = folder.finished()
    if finished is not None:
        log.info("this run exists: %s (nothing was computed)", folder.path)
        return _say(finished, folder)
    text = _text_encoder(config, scene)
    folder.config.write_text(OmegaConf.to_yaml(config, resolve=True))
    module, stopped_by = _train(folder, config, scene)
    if stopped_by is not None:
        log.warning(
            "%s: stopped and saved at step %d of %d; the same command goes on from there:\n  %s",
            stopped_by,
            module.next_step,
            module.settings.iterations,
            _command(),
        )
        return STOPPED
    return _say(_report(folder, config, scene, module, text), folder)


def _say(metrics: dict[str, Any], folder: RunFolder) -> int:
    """Print a result; the exit status says whether it has the scores that were asked for."""
    from vlgs.report.summary import print_summary

    print_summary(metrics, _places(folder))
    return UNSCORED if metrics.get("failure") else 0


def _text_encoder(config: DictConfig, scene: Any) -> Any:
    """What turns the scene's classes into vectors; None where nothing can be asked.

    A word that it does not know is an error now, not after training.
    """
    from vlgs.query import encode_prompts
    from vlgs.query.text import VocabularyText

    if not scene.classes or scene.mask_vectors.shape[0] == 0:
        return None
    text = instantiate(config.text)(vocabulary=scene.vocabulary)
    if isinstance(text, VocabularyText) and scene.vocabulary is None:
        log.warning(
            "no vocabulary: language is trained but not scored (data.vocabulary=FILE or text=clip)"
        )
        return None
    encode_prompts(instantiate(config.query), text, scene.classes)
    return text


def _train(folder: RunFolder, config: DictConfig, scene: Any) -> tuple[Any, str | None]:
    import torch

    from vlgs.module.build import Parts, build_module
    from vlgs.module.fit import FitOptions, fit

    # Initial weights of the fusion come from the global generator; every other draw has one of its own.
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    module = build_module(scene, parts, config.seed)
    options = FitOptions(
        meta={
            "config": OmegaConf.to_container(config, resolve=True),
            "fingerprint": scene.fingerprint,
        },
        progress=config.progress,
        loggers=[instantiate(logger) for logger in config.logger.loggers],
    )
    return module, fit(module, folder, options)


def _report(
    folder: RunFolder, config: DictConfig, scene: Any, module: Any, text: Any
) -> dict[str, Any]:
    """Everything that is said about a trained model; metrics.json is written last and makes the run a finished one."""
    from vlgs.gaussians import write_ply
    from vlgs.report.evaluate import evaluate, prompts_of
    from vlgs.report.pictures import write_pictures
    from vlgs.report.provenance import commit, machine
    from vlgs.report.results import write_metrics, write_queries
    from vlgs.report.timing import measure_fps

    model, query, protocol = module.model, instantiate(config.query), instantiate(config.protocol)
    write_ply(folder.ply, model.splats)
    evaluation = evaluate(model, scene, query, text, protocol)
    prompts, _ = prompts_of(scene, query, text)
    timing = measure_fps(model, [view.camera for view in scene.test or scene.train], query, prompts)
    if config.pictures:
        write_pictures(folder.renders, model, scene, query, prompts)
    extra = {
        "n_gaussians": model.count,
        "train_seconds": module.train_seconds,
        "skips": module.skips.report(),
        "peak_rss_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "ply_bytes": folder.ply.stat().st_size,
        "checkpoint_bytes": max(f.stat().st_size for f in folder.checkpoint.glob("*.safetensors")),
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
    return " ".join(["python -m vlgs.run", *HydraConfig.get().overrides.task])


if __name__ == "__main__":
    main()
