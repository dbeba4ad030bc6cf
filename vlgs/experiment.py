"""The one place where a configuration becomes typed parts. What is below it, from the first view read to the last score, sees these alone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.initialize import get_gh_backup, restore_gh_from_backup
from omegaconf import DictConfig

from vlgs.config import instantiate
from vlgs.demands import Demand, has, unmet
from vlgs.identity import GIVEN_FILES, RunIdentity, given_folders, identity, run_id, trained_id
from vlgs.known import CONF, option, options
from vlgs.metrics.protocol import Auto, EvaluationProtocol
from vlgs.places import record
from vlgs.queries import Query, TextEncoder
from vlgs.training.augment import Augment
from vlgs.training.build import Parts, scaled
from vlgs.training.levels import LEVEL_OPTIONS, Levels
from vlgs.training.stages import Method, Stages
from vlgs.types import Scene

if TYPE_CHECKING:
    from lightning.pytorch.loggers import Logger

Scenes = Mapping[int | None, Scene]
"""Mask level -> scene; the last one, of whole objects where there are several, stands for what they share."""


@dataclass(frozen=True)
class Experiment:
    """All that a command line says, constructed."""

    parts: Parts
    """To be looked at, not to be trained."""
    make_parts: Callable[[], Parts]
    """Parts to be trained: new ones for each model, with the same initial weights each time."""
    sharing: Stages
    method: Method | None
    """Stages in place of those of `sharing`."""
    augment: Augment
    levels: Levels
    level_models: str
    """What the command line calls `levels`."""
    query: Query
    protocol: EvaluationProtocol | Auto
    make_text: Callable[..., TextEncoder]
    """Takes the vocabulary of the scene, as `vocabulary`."""
    make_loggers: "Callable[[], list[Logger]]"
    """New ones for each model."""
    read_scene: Callable[..., Scene]
    """Takes a mask level, as `level`; by default the data's own."""
    level: int | None
    """The data's own mask level."""
    given_files: Mapping[str, str]
    """Dotted key -> file to start from."""
    given_folders: Mapping[str, str]
    """Dotted key -> folder of files to learn from."""
    seed: int
    threads: int
    results: Path
    refuse_existing: bool
    """Whether a run that is there already is an error."""
    progress: bool
    pictures: bool
    dataset: str
    """Name of the option of conf/data."""
    record: Mapping[str, Any]
    """The configuration in JSON values, as it is kept with the run."""
    identity: RunIdentity
    run_id: Callable[[str], str]
    """Takes what stands for the content of the data."""
    trained_id: Callable[[str], str]
    """Likewise; see `vlgs.identity.trained_id`."""

    def read_scenes(self) -> Scenes:
        """The scene at every mask level that is wanted.

        Raises:
            ValueError: If the scene is at fault.
            OSError: If a file is not there.
        """
        if not self.levels.read:
            return {self.level: self.read_scene()}
        return {level: self.read_scene(level=level) for level in self.levels.read}

    def stages(self) -> list[Stages]:
        """The options that the stages come from, in the order of these: further views, mask levels, models."""
        return [self.augment, self.levels, self.method or self.sharing]


def construct(config: DictConfig) -> Experiment:
    """Construct everything that a checked configuration names (`vlgs.config.check_config`); no data are read.

    Raises:
        ValueError: If an argument is at fault, or options do not go together.
        OSError: If a file of weights is not there.
    """
    make_parts = partial(_make_parts, config)
    parts = make_parts()
    experiment = Experiment(
        parts=parts,
        make_parts=make_parts,
        sharing=instantiate(config.sharing),
        method=_method(config),
        query=instantiate(config.query),
        protocol=instantiate(config.protocol),
        make_text=instantiate(config.text),
        augment=instantiate(config.augment),
        levels=LEVEL_OPTIONS[config.levels],
        level_models=config.levels,
        make_loggers=lambda: [instantiate(logger) for logger in config.logger.loggers],
        read_scene=partial(instantiate, config.data),
        level=config.data.get("level"),
        given_files=_given_files(config),
        given_folders=given_folders(config),
        seed=config.seed,
        threads=config.threads,
        results=Path(config.results),
        refuse_existing=config.on_existing == "refuse",
        progress=config.progress,
        pictures=config.pictures,
        dataset=_dataset(config),
        record=record(config),
        identity=identity(config),
        run_id=partial(run_id, config),
        trained_id=partial(trained_id, config),
    )
    chosen = {field.name: getattr(parts, field.name) for field in fields(Parts)}
    for key in ("augment", "levels", "method", "query"):
        chosen[key] = getattr(experiment, key)
    chosen |= {f"loss.{name}": objective for name, objective in parts.loss.items()}
    for demand in unmet(chosen):
        raise ValueError(_refusal(config, demand))
    return experiment


def _make_parts(config: DictConfig) -> Parts:
    # Initial weights of the fusion come from the global generator; every other draw has one of its own.
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    terms = {name: term for name, term in parts.loss.items() if term is not None}
    return scaled(replace(parts, loss=terms), parts.trainer.steps_scaler, interval=True)


def _method(config: DictConfig) -> Method | None:
    stages = config.get("stages")
    return None if stages is None else Method([instantiate(stage) for stage in stages])


def _given_files(config: DictConfig) -> dict[str, str]:
    given = {key: config[group].get(key) for group, key in GIVEN_FILES}
    return {key: str(path) for key, path in given.items() if path}


def _dataset(config: DictConfig) -> str:
    """The chosen option of conf/data; without a command line, the name of the module that reads the scene."""
    if HydraConfig.initialized():
        return str(HydraConfig.get().runtime.choices["data"])
    return str(config.data._target_).split(".")[-2]


def _refusal(config: DictConfig, demand: Demand) -> str:
    """Names both options, and those that would do."""
    group, why = demand.group, f", {demand.why}" if demand.why else ""
    if group == "levels":
        fitting = [name for name, levels in LEVEL_OPTIONS.items() if has(levels, demand.needed)]
        got = str(config.levels)
    else:
        each = _options(group)
        fitting = [name for name, said in each.items() if has(instantiate(said), demand.needed)]
        target = str(config[group].get("_target_", "terms of its own"))
        same = (name for name, said in each.items() if said == config[group])
        got = next(same, None) or option(group, target) or target
        if got in fitting:
            got += " with other values"
    return f"config: {group} must be {' or '.join(fitting)} with {demand.asker}{why}, got {got}"


def _options(group: str) -> dict[str, DictConfig]:
    """Every option of a group of ours, as it is by default."""
    running = get_gh_backup()  # Hydra's program around a run, beside which it allows no second one
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return {name: compose("config", [f"{group}={name}"])[group] for name in options(group)}
    finally:
        restore_gh_from_backup(running)
