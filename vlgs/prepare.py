"""Everything that a run does before its first step. `vlgs.run` and `vlgs.check` share it, so that both refuse the same things with the same words."""

import copy
import logging
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from vlgs.data.diagnostics import Fault, warning
from vlgs.experiment import Experiment, Scenes
from vlgs.formats import file_digest, folder_digest, load_weights
from vlgs.heads import FittedHead, Head, Particular
from vlgs.ops.rasterize import check_config as check_constants
from vlgs.queries import Particular as ParticularQuery
from vlgs.queries import TextEncoder, encode_questions, words_of
from vlgs.queries.text import VocabularyText
from vlgs.report.evaluate import evaluate
from vlgs.runs import RunFolder
from vlgs.training.build import Parts
from vlgs.training.fit import FitOptions
from vlgs.training.stages import run_stages
from vlgs.training.workshop import Workshop
from vlgs.types import Scene

log = logging.getLogger(__name__)

_LEAST = 6
"""Pixels on a side that `vlgs.metrics.image.ssim` asks for."""

_STEPS = 2
"""Of a rehearsal: the second is the first that comes after a change of the parameters."""


@dataclass(frozen=True)
class Prepared:
    """A run that could begin: what it is told, what it learns, and the id that follows from both."""

    experiment: Experiment
    scenes: Scenes
    run_id: str
    trained_id: str
    """Equal where the models of two runs are (`vlgs.identity.trained_id`)."""

    @property
    def scene(self) -> Scene:
        """The one that stands for what all mask levels share."""
        return list(self.scenes.values())[-1]

    @property
    def fingerprint(self) -> str:
        """Stands for the content of the data."""
        return " ".join(scene.fingerprint for scene in self.scenes.values())


def prepare(experiment: Experiment) -> Prepared:
    """Read the scene, at every mask level that is wanted, and refuse what could not be trained.

    Raises:
        ValueError: If a file or an option is at fault.
        OSError: If a file is not there.
    """
    torch.set_num_threads(experiment.threads)
    check_constants(experiment.parts.raster)
    scenes = experiment.read_scenes()
    ready = Prepared(experiment, scenes, "", "")
    _require_sizes(ready.scene)
    experiment.augment.require(scenes)
    if experiment.method is not None:
        experiment.method.require(scenes)
        _require_head(experiment.parts.head, scenes.values())
    read = {"": " ".join(filter(None, [ready.fingerprint, experiment.augment.identity()]))}
    read |= {key: file_digest(path, key) for key, path in experiment.given_files.items()}
    read |= {key: folder_digest(path, key) for key, path in experiment.given_folders.items()}
    trained = (digest for key, digest in read.items() if not key.startswith("query."))
    return replace(
        ready,
        run_id=experiment.run_id(" ".join(read.values())),
        trained_id=experiment.trained_id(" ".join(trained)),
    )


def doubts(experiment: Experiment) -> Iterator[Fault]:
    """Warnings about settings that are allowed but probably not intended; `vlgs.check` lists them, `vlgs.run` logs them."""
    for name, rate in asdict(experiment.parts.trainer.learning_rates).items():
        if rate == 0:
            what = "learning rate should be above 0, got 0"
            yield warning(f"trainer.learning_rates.{name}", what, "this does not learn")
    densify = experiment.parts.gaussians.densify
    if 0 < densify.stop <= densify.start:
        what = f"stop should be above start ({densify.start}), got {densify.stop}"
        yield warning("gaussians.densify", what, "nothing is densified; stop=0 says so")
    threads, there = experiment.threads, os.cpu_count() or 1
    if threads > there:
        yield warning("threads", f"threads should be at most {there} here, got {threads}")


def text_encoder(experiment: Experiment, scene: Scene) -> TextEncoder | None:
    """The text encoder for the scene's words; None if there is nothing to ask.

    Raises:
        ValueError: If a class or a negative is a word that it does not know, or the query cannot learn what it means: an error now, not
            after training.
    """
    if scene.mask_vectors.shape[0] == 0:
        log.info("no language supervision: training colour only, without fusion or blended views")
        return None
    text, query = experiment.make_text(vocabulary=scene.vocabulary), experiment.query
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
    if isinstance(query, ParticularQuery) and scene.classes:
        query.require(scene, scene.classes)
    return text


def make_workshop(folder: RunFolder, ready: Prepared) -> Workshop:
    """What trains the models of a run in its folder."""
    experiment = ready.experiment

    def make_options() -> FitOptions:
        meta = {"config": experiment.record, "fingerprint": ready.fingerprint}
        return FitOptions(meta, experiment.progress, experiment.make_loggers())

    return Workshop(folder, experiment.make_parts, make_options, experiment.seed)


def rehearse(ready: Prepared) -> None:
    """Try a run in a temporary folder: encode the words, build every model, train each for two steps, score a view.

    Raises:
        ValueError: What the run would end with.
        OSError: Likewise.
        FloatingPointError: Likewise.
    """
    experiment, scene = ready.experiment, ready.scene
    text = text_encoder(experiment, scene)
    experiment.make_loggers()

    def make_parts() -> Parts:
        parts = experiment.make_parts()
        head, trainer = parts.head, parts.trainer
        if isinstance(head, FittedHead):
            head.rehearse(_STEPS)
        return replace(parts, trainer=replace(trainer, iterations=min(_STEPS, trainer.iterations)))

    _, *further = experiment.stages()  # views are not added: that takes as long as the run
    with TemporaryDirectory() as scratch:
        options = FitOptions(meta={}, progress=False)
        workshop = Workshop(RunFolder(Path(scratch)), make_parts, lambda: options, experiment.seed)
        field = run_stages(further, ready.scenes, workshop).field()
    seen = replace(scene, test=scene.test[:1])
    evaluate(field, seen, experiment.query, text, experiment.protocol)


def _require_head(head: Head, scenes: Iterable[Scene]) -> None:
    """Refuse a head before the first stage of a method, which may have no language and take most of the run."""
    seen = [scene for scene in scenes if len(scene.mask_vectors)]
    if isinstance(head, Particular):
        for scene in seen:
            head.require(scene.mask_vectors)
    if seen and isinstance(head, FittedHead) and head.weights is not None:
        load_weights(copy.deepcopy(head), head.weights)


def _require_sizes(scene: Scene) -> None:
    """Refuse held-out views that no score can be given to."""
    for view in scene.test:
        width, height = view.camera.width, view.camera.height
        if min(width, height) < _LEAST:
            raise ValueError(
                f"{view.name}: held-out views must be at least {_LEAST} x {_LEAST} pixels, as SSIM's window mirrors half of "
                f"itself, got {width} x {height}"
            )
