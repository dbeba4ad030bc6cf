"""The configuration as benchmarks need it: raster presets, training runs, a trained scene."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from vlgs.config import CONF, check_config, check_targets, instantiate
from vlgs.identity import run_id
from vlgs.known import options
from vlgs.module.build import Parts, build_module
from vlgs.module.checkpoint import load_checkpoint
from vlgs.module.fit import FitOptions, fit
from vlgs.module.lightning import VLGSModule
from vlgs.module.state import restore
from vlgs.places import found_again, record, write_config
from vlgs.runs import RunFolder
from vlgs.types import RasterConfig, Scene


@dataclass(frozen=True)
class Trained:
    """A trained scene and the configuration it was trained with."""

    config: DictConfig
    scene: Scene
    module: VLGSModule


def composed(overrides: Sequence[str]) -> DictConfig:
    """The configuration of `python -m vlgs.run <overrides>`.

    Raises:
        ValueError: If it cannot work.
    """
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=list(overrides))
    check_config(config)
    return config


def raster_presets() -> dict[str, RasterConfig]:
    """Every option of the group ``raster``, most exact first."""
    found = {name: instantiate(composed([f"raster={name}"]).raster) for name in options("raster")}
    return dict(sorted(found.items(), key=lambda item: item[1].transmittance_min))


def build(config: DictConfig, scene: Scene) -> VLGSModule:
    """The module that `python -m vlgs.run` would train."""
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, config.seed)


def train_or_load(overrides: Sequence[str], results: Path) -> Trained:
    """A trained scene; it shares its folder with `python -m vlgs.run`, so that what is trained is not trained again."""
    config = composed([*overrides, f"results={results}"])
    scene = instantiate(config.data)
    module = build(config, scene)
    meta = {
        "config": record(config),
        "fingerprint": scene.fingerprint,
    }
    folder = RunFolder(results / "runs" / run_id(config, scene.fingerprint))
    with folder.writing() as own:
        write_config(own.config, config)
        if fit(module, own, FitOptions(meta)) is not None:
            raise KeyboardInterrupt
    return Trained(config, scene, module)


def train_a_little(overrides: Sequence[str], steps: int = 25) -> Trained:
    """A scene after its first iterations, without densification; nothing is written."""
    config = composed(overrides)
    scene = instantiate(config.data)
    module = build(config, scene)
    for step in range(steps):
        module.training_step(step, step)
    return Trained(config, scene, module)


def load_run(path: Path) -> Trained:
    """A scene that `python -m vlgs.run` trained.

    Raises:
        ValueError: If the folder holds no run with a checkpoint, or its data are not those it was trained on.
    """
    folder = RunFolder(path)
    checkpoint = load_checkpoint(folder.checkpoint) if folder.config.is_file() else None
    if checkpoint is None:
        raise ValueError(f"bench: {path} must be a run folder with a checkpoint, got none")
    config = found_again(path.resolve())
    check_targets(config, plugins=())  # a file's word is nobody's trust
    scene: Any = instantiate(config.data)
    if scene.fingerprint != checkpoint.meta.get("fingerprint"):
        raise ValueError(f"bench: data of {path} must be those of its training, got others")
    module = build(config, scene)
    restore(module, checkpoint)
    return Trained(config, scene, module)
