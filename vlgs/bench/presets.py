"""The configuration as benchmarks need it: raster presets, training runs, a trained scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from vlgs.config import CONF, check_config, check_targets, instantiate
from vlgs.earlier import as_today
from vlgs.experiment import Experiment, construct
from vlgs.known import options
from vlgs.places import found_again, write_config
from vlgs.runs import RunFolder
from vlgs.training.build import build_module
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.training.state import restore
from vlgs.types import RasterConfig, Scene


@dataclass(frozen=True)
class Trained:
    """A trained scene and what its training was told."""

    experiment: Experiment
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


def build(experiment: Experiment, scene: Scene) -> VLGSModule:
    """The module that `python -m vlgs.run` would train."""
    return build_module(scene, experiment.make_parts(), experiment.seed)


def train_or_load(overrides: Sequence[str], results: Path) -> Trained:
    """A trained scene; it shares its folder with `python -m vlgs.run`, so that what is trained is not trained again."""
    experiment = construct(composed([*overrides, f"results={results}"]))
    scene = experiment.read_scene()
    module = build(experiment, scene)
    meta = {"config": experiment.record, "fingerprint": scene.fingerprint}
    folder = RunFolder(results / "runs" / experiment.run_id(scene.fingerprint))
    with folder.writing() as own:
        write_config(own.config, experiment.record)
        if fit(module, own, FitOptions(meta)) is not None:
            raise KeyboardInterrupt
    return Trained(experiment, scene, module)


def train_a_little(overrides: Sequence[str], steps: int = 25) -> Trained:
    """A scene after its first iterations, without densification; nothing is written."""
    experiment = construct(composed(overrides))
    scene = experiment.read_scene()
    module = build(experiment, scene)
    for step in range(steps):
        module.training_step(step, step)
    return Trained(experiment, scene, module)


def load_run(path: Path) -> Trained:
    """A scene that `python -m vlgs.run` trained.

    Raises:
        ValueError: If the folder holds no run with a checkpoint, or its data are not those it was trained on.
    """
    folder = RunFolder(path)
    checkpoint = load_checkpoint(folder.checkpoint) if folder.config.is_file() else None
    if checkpoint is None:
        raise ValueError(f"bench: {path} must be a run folder with a checkpoint, got none")
    config = as_today(found_again(path.resolve()))
    check_targets(config, plugins=())  # a file's word is nobody's trust
    experiment = construct(config)
    scene = experiment.read_scene()
    if scene.fingerprint != checkpoint.meta.get("fingerprint"):
        raise ValueError(f"bench: data of {path} must be those of its training, got others")
    module = build(experiment, scene)
    restore(module, checkpoint)
    return Trained(experiment, scene, module)
