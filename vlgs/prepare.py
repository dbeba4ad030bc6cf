"""Everything that a run does before its first step. `vlgs.run` and `vlgs.check` share it, so that both refuse the same things with the same words."""

import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from omegaconf import DictConfig

from vlgs.config import LEVELS, check_config, instantiate
from vlgs.data.faults import Fault, warning
from vlgs.identity import GIVEN_FILES, run_id
from vlgs.places import record

log = logging.getLogger(__name__)

Scenes = dict[int | None, Any]
"""Mask level -> scene; the last one, of whole objects where there are several, stands for what they share."""

_LEAST = 6
"""Pixels on a side that `vlgs.metrics.image.ssim` asks for."""

_STEPS = 2
"""Of a rehearsal: the second is the first that comes after a change of the parameters."""


@dataclass(frozen=True)
class Prepared:
    """What a run is made of, and the id that follows from it."""

    scenes: Scenes
    content: str
    """Stands for all that was read: fingerprints of the scenes, digests of files that are given."""
    run_id: str


def prepare(config: DictConfig) -> Prepared:
    """Check the configuration and read the scene, at every mask level that is wanted.

    Raises:
        ValueError: If a key, a file or an option is at fault.
        OSError: If a file is not there.
    """
    check_config(config)
    import torch

    from vlgs.interchange import file_digest
    from vlgs.ops.rasterize import check_config as check_constants

    torch.set_num_threads(config.threads)
    check_constants(_make_parts(config).raster)
    for group in ("sharing", "query", "protocol", "text"):
        instantiate(config[group])
    given = {key: config[group].get(key) for group, key in GIVEN_FILES}
    augment = instantiate(config.augment)
    scenes = _scenes(config)
    _require_sizes(next(reversed(scenes.values())))
    augment.require(scenes)
    content = [*(scene.fingerprint for scene in scenes.values()), augment.identity()]
    content += [file_digest(path, key) for key, path in given.items() if path]
    read = " ".join(filter(None, content))
    return Prepared(scenes, read, run_id(config, read))


def doubts(config: DictConfig) -> Iterator[Fault]:
    """Warnings about settings that are allowed but probably not intended; `vlgs.check` lists them, `vlgs.run` logs them."""
    for name, rate in config.trainer.learning_rates.items():
        if rate == 0:
            what = "learning rate should be above 0, got 0"
            yield warning(f"trainer.learning_rates.{name}", what, "this does not learn")
    densify = config.gaussians.densify
    if 0 < densify.stop <= densify.start:
        what = f"stop should be above start ({densify.start}), got {densify.stop}"
        yield warning("gaussians.densify", what, "nothing is densified; stop=0 says so")
    if config.threads > (there := os.cpu_count() or 1):
        yield warning("threads", f"threads should be at most {there} here, got {config.threads}")


def text_encoder(config: DictConfig, scene: Any) -> Any:
    """The text encoder for the scene's words; None if there is nothing to ask.

    Raises:
        ValueError: If a class or a negative is a word that it does not know: an error now, not after training.
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


def make_stages(folder: Any, config: DictConfig, scenes: Scenes) -> Any:
    """What trains the models of a run in its folder."""
    from vlgs.module.fit import FitOptions
    from vlgs.module.stages import Stages

    def make_options() -> FitOptions:
        meta = {
            "config": record(config),
            "fingerprint": " ".join(scene.fingerprint for scene in scenes.values()),
        }
        loggers = [instantiate(logger) for logger in config.logger.loggers]
        return FitOptions(meta=meta, progress=config.progress, loggers=loggers)

    return Stages(folder, lambda: _make_parts(config), make_options, config.seed)


def rehearse(config: DictConfig, scenes: Scenes) -> None:
    """Try a run in a temporary folder: encode the words, build every model, train each for two steps, score a view.

    Raises:
        ValueError: What the run would end with.
        OSError: Likewise.
        FloatingPointError: Likewise.
    """
    from vlgs.heads.autoencoder import Autoencoder
    from vlgs.module.augment import NoAugment
    from vlgs.module.build import Parts
    from vlgs.module.fit import FitOptions
    from vlgs.module.stages import Stages, train_all
    from vlgs.report.evaluate import evaluate
    from vlgs.runs import RunFolder

    scene = next(reversed(scenes.values()))
    text = text_encoder(config, scene)
    for logger in config.logger.loggers:
        instantiate(logger)

    def make_parts() -> Parts:
        parts = _make_parts(config)
        head, trainer = parts.head, parts.trainer
        if isinstance(head, Autoencoder):
            steps = min(_STEPS, head.fit_settings.steps)
            head.fit_settings, head.cache_dir = replace(head.fit_settings, steps=steps), None
        return replace(parts, trainer=replace(trainer, iterations=min(_STEPS, trainer.iterations)))

    with TemporaryDirectory() as scratch:
        options = FitOptions(meta={}, progress=False)
        stages = Stages(RunFolder(Path(scratch)), make_parts, lambda: options, config.seed)
        joint = config.levels == "joint"
        field = train_all(stages, scenes, instantiate(config.sharing), NoAugment(), joint=joint)
    query, protocol = instantiate(config.query), instantiate(config.protocol)
    evaluate(field, replace(scene, test=scene.test[:1]), query, text, protocol)


def _make_parts(config: DictConfig) -> Any:
    import torch

    from vlgs.module.build import Parts

    # Initial weights of the fusion come from the global generator; every other draw has one of its own.
    torch.manual_seed(config.seed)
    return Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})


def _require_sizes(scene: Any) -> None:
    """Refuse held-out views that no score can be given to."""
    for view in scene.test:
        width, height = view.camera.width, view.camera.height
        if min(width, height) < _LEAST:
            raise ValueError(
                f"{view.name}: held-out views must be at least {_LEAST} x {_LEAST} pixels, as SSIM's window mirrors half of "
                f"itself, got {width} x {height}"
            )


def _scenes(config: DictConfig) -> Scenes:
    if config.levels == "single":
        return {config.data.get("level"): instantiate(config.data)}
    return {level: instantiate(config.data, level=level) for level in LEVELS}
