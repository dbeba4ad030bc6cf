"""Everything that a run does after its last step: scores, pictures, point clouds, and the metrics that mark it as finished."""

import logging
import resource
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.initialize import get_gh_backup, restore_gh_from_backup

from vlgs.experiment import Experiment
from vlgs.fields import Field, HasGaussians
from vlgs.fields.cloud import write_point_cloud
from vlgs.identity import RESULTS_VERSION
from vlgs.known import option
from vlgs.opened import open_run
from vlgs.opened.files import write_field
from vlgs.prepare import Prepared, text_encoder
from vlgs.queries import Learning, TextEncoder
from vlgs.report.answer import KeptAnswers
from vlgs.report.evaluate import evaluate, prompts_of
from vlgs.report.pictures import OVERVIEW, drawn, write_pictures
from vlgs.report.provenance import commit, machine
from vlgs.report.results import write_metrics, write_queries
from vlgs.report.timing import measure_fps
from vlgs.report.words import questions_of
from vlgs.runs import RunFolder
from vlgs.training.separate import without_language
from vlgs.training.stages import Progress
from vlgs.training.workshop import Workshop, all_skips

log = logging.getLogger(__name__)


def report(
    ready: Prepared,
    progress: Progress,
    workshop: Workshop,
    text: TextEncoder | None,
    trained: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """Evaluate the trained scene and write scores, pictures and point clouds. metrics.json is written last: it marks the run as finished.

    Args:
        ready: What the run was told.
        progress: Whose result is evaluated.
        workshop: That made it, in the folder of the run.
        text: Encodes words; None if there is nothing to ask.
        trained: Metrics of the run that trained the models, if it was another.

    Returns:
        The content of metrics.json.
    """
    experiment, scene, folder = ready.experiment, ready.scene, workshop.folder
    field, query = progress.field(), experiment.query
    if not field.has_language:
        scene, text = without_language(scene), None
    language = len(scene.mask_vectors) > 0
    folder.require_own()
    cameras = [view.camera for view in scene.train]
    clouds = [
        made.folder.ply
        for made in workshop.kept
        if write_point_cloud(made.folder.ply, made.field, cameras)
    ]
    words, _ = prompts_of(scene, query, text)
    if isinstance(query, Learning) and words is not None:
        field = query.learn(field, scene, words)
    kept = KeptAnswers(drawn(scene) if experiment.pictures else ())
    evaluation = evaluate(field, scene, query, text, experiment.protocol, kept)
    asked = questions_of(field, scene, query, text)
    prompts = asked.prompts if asked else None
    notes: dict[str, str] = {}
    if asked and asked.note:
        query = asked.query
        notes["words"] = asked.note
    if len(progress.scenes) > 1 and field.has_language:
        first, *_, last = progress.scenes
        notes["pictures"] = (
            f"of the model of mask level {last}, as are frame rates; psnr and ssim of that of {first}"
        )
    counted = isinstance(field, HasGaussians)
    if not counted:
        notes["n_gaussians"] = "the field is not made of Gaussians"
    evaluation = replace(evaluation, reasons={**evaluation.reasons, **notes})
    cameras = [view.camera for view in scene.test or scene.train]
    timing = measure_fps(field, cameras, query, prompts, language)
    if experiment.pictures:
        write_pictures(folder.renders, field, scene, query, prompts, kept=kept)
    extra = {
        "n_gaussians": sum(made.gaussians for made in workshop.kept) if counted else None,
        "levels": [level for level in ready.scenes if level is not None] if language else [],
        "level_models": experiment.level_models,
        "query": _query(experiment) if language else None,
        "train_seconds": sum(made.seconds for made in workshop.made.values()),
        "skips": all_skips(workshop.made.values()).report(),
        "peak_rss_bytes": max(_peak_bytes(), trained.get("peak_rss_bytes") or 0),
        "ply_bytes": sum(path.stat().st_size for path in clouds) if clouds else None,
        "checkpoint_bytes": sum(made.checkpoint_bytes for made in workshop.kept),
        "seed": experiment.seed,
        "config_hash": folder.path.name,
        "recipe": experiment.identity.recipe,
        "data_recipe": experiment.identity.data,
        "dataset": experiment.dataset,
        "scene": scene.name,
        "fingerprint": scene.fingerprint,
        "training": ready.trained_id,
        "results_version": RESULTS_VERSION,
        "commit": commit(),
        "machine": machine(),
        **asdict(timing),
    }
    folder.require_own()
    _keep(folder, field, experiment.parts.trainer.iterations)
    write_queries(folder.queries, evaluation)
    return write_metrics(folder.metrics, evaluation, extra)


def draw_missing(ready: Prepared, folder: RunFolder) -> bool:
    """Draw the pictures of a finished run that has none, as `report` would have, from the model that it kept; no number changes.

    Where the run keeps no model that can be opened, a warning says so and what to do.

    Args:
        ready: What the run was told.
        folder: Of the run.

    Returns:
        Whether something was drawn: not where pictures are not wanted, are there, or would show no view.
    """
    experiment, scene = ready.experiment, ready.scene
    if not experiment.pictures or (folder.renders / OVERVIEW).exists() or not drawn(scene):
        return False
    try:
        if not folder.field.is_file():  # a checkpoint need not be all of the result
            raise ValueError(f"{folder.field} must be there, got none")
        field = _opened(folder, experiment.record["plugins"])
        if not field.has_language:
            scene = without_language(scene)
        asked = questions_of(field, scene, experiment.query, text_encoder(experiment, scene))
    except (ValueError, OSError) as error:
        log.warning(
            "pictures are not drawn: %s; without %s the same command reports the run again from its checkpoint, and draws them",
            *(error, folder.metrics),
        )
        return False
    query = asked.query if asked else experiment.query
    write_pictures(folder.renders, field, scene, query, asked.prompts if asked else None)
    return True


def _opened(folder: RunFolder, plugins: Sequence[str]) -> Field:
    """The field that a run kept."""
    running = (
        get_gh_backup()
    )  # `open_run` composes options, which Hydra's program around a run does not allow
    GlobalHydra.instance().clear()
    try:
        return open_run(folder.path, plugins=plugins).field
    finally:
        restore_gh_from_backup(running)


def _peak_bytes() -> int:
    """Most memory that this process ever held."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _query(experiment: Experiment) -> str:
    """How words were asked, and whose masks taught what they mean where these were given."""
    said = experiment.record["query"]
    name = option("query", said["_target_"]) or said["_target_"]
    return f"{name}, masks of {Path(said['masks']).name}" if said.get("masks") else name


def _keep(folder: RunFolder, field: Field, step: int) -> None:
    """Keep the field for those who open the run; one of a user's own kind stays with the checkpoints."""
    try:
        write_field(folder, field, step)
    except ValueError as error:
        log.warning("%s; vlgs.query, render, view and export cannot open this run", error)
