"""What a raster configuration does to the scores of a trained scene."""

from copy import copy
from dataclasses import dataclass

import torch

from vlgs.bench.presets import Trained
from vlgs.experiment import Experiment
from vlgs.fields import Field
from vlgs.fields.trained import SplatField
from vlgs.report.evaluate import Evaluation, evaluate
from vlgs.types import RasterConfig, Scene


@dataclass(frozen=True)
class Quality:
    """Scores on the held-out views; None where there is no trained scene or the score is not available."""

    psnr: float | None = None
    """dB."""
    miou: float | None = None
    psnr_change: float | None = None
    """Against the preset ``exact``, dB."""
    miou_change: float | None = None


def score(experiment: Experiment, scene: Scene, field: Field) -> Evaluation:
    """The evaluation that ends `python -m vlgs.run`, without its pictures."""
    text = None
    if scene.classes and scene.mask_vectors.shape[0] > 0 and scene.vocabulary is not None:
        text = experiment.make_text(vocabulary=scene.vocabulary)
    with torch.no_grad():
        return evaluate(field, scene, experiment.query, text, experiment.protocol)


def measure_quality(trained: Trained | None, raster: RasterConfig, exact: RasterConfig) -> Quality:
    """Scores when the trained scene is rendered with other constants; nothing is trained again."""
    if trained is None:
        return Quality()
    got, true = (_scores_with(trained, config) for config in (raster, exact))
    changes = [None if a is None or b is None else a - b for a, b in zip(got, true, strict=True)]
    return Quality(*got, *changes)


def _scores_with(trained: Trained, raster: RasterConfig) -> tuple[float | None, float | None]:
    model = trained.module.model
    before = copy(model.raster)
    model.raster = raster
    try:
        evaluation = score(trained.experiment, trained.scene, SplatField(model))
    finally:
        model.raster = before
    return evaluation.psnr, evaluation.miou
