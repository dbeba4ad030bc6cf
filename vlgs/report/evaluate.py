"""Scores of a trained scene on its held-out views."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch

from vlgs.fields import NO_GAUSSIANS, NO_LANGUAGE, Field, gaussians_of
from vlgs.metrics import image
from vlgs.metrics.masks import QueryScore
from vlgs.metrics.mean import mean_of_known
from vlgs.metrics.protocol import Auto, EvaluationProtocol, tag
from vlgs.queries import Prompts, Query, TextEncoder, encode_prompts
from vlgs.report.answer import Answer, KeptAnswers
from vlgs.report.indicator import Histogram
from vlgs.report.language import DENSE, LERF_OVS, LanguageScores, LanguageTally
from vlgs.report.splats import SplatAnswers
from vlgs.types import Scene, View


@dataclass(frozen=True)
class Evaluation:
    """Scores of one run. None means not available, and `reasons` says why; a missing score is never 0 or 1."""

    protocol: str
    """`vlgs.metrics.protocol.tag` of the headline: name, version and split, such as ``dense@1/synthetic``."""
    psnr: float | None
    """Mean over views, dB."""
    ssim: float | None
    """Mean over views."""
    miou: float | None
    """Headline mIoU in [0, 1]."""
    loc_acc: float | None
    """Headline localisation accuracy in [0, 1]."""
    per_category: Mapping[str, float | None]
    """IoU of each category under the headline's protocol."""
    per_view: Mapping[str, Mapping[str, float | None]]
    """View name -> psnr, ssim."""
    beside: Mapping[str, float | int | None] = field(default_factory=dict)
    """Further figures under the names of `vlgs.report.results.METRICS`."""
    reasons: Mapping[str, str] = field(default_factory=dict)
    """Metric -> why it is not available; faults of the labels stand under ``labels``, what the pictures ask without any under ``words``."""
    failure: str | None = None
    """Why the evaluation failed: a protocol or labels asked for scores, and nothing could be scored."""
    category_kinds: Mapping[str, str] = field(default_factory=dict)
    """Kind of each category, where the scene says it: ``translucent_reflective`` or ``other``."""
    indicator: Mapping[str, Sequence[float]] | None = None
    """`vlgs.report.indicator.Histogram` of l - o; None where no held-out view has a class for every pixel, or there are no Gaussians."""
    queries: Sequence[Mapping[str, str | int | float | bool | None]] = ()
    """Rows of `query_rows`."""


@torch.no_grad()
def evaluate(
    field: Field,
    scene: Scene,
    query: Query,
    text: TextEncoder | None,
    protocol: EvaluationProtocol | Auto,
    kept: KeptAnswers | None = None,
) -> Evaluation:
    """Render every held-out view once and score colour and language.

    Units of LERF-OVS come from object labels where a view has them, otherwise one per class that its dense labels show: such a
    unit has no box, and a hit is a pixel of its mask. Beside its scores stand those of exact
    features (`_ceiling`), where every pixel carries the text vector of its true class: most answers stay below them, one that is
    smoother may pass them where a class is smaller than the window of the protocol.

    Args:
        field: The trained scene.
        scene: Its held-out views, labels and classes.
        query: Relevancy of a prompt.
        text: Encodes `Scene.classes`. Without it, or if it lacks a word, there are no language scores, and the reason is given.
        protocol: Which scores are the headline; the dense ones and those of LERF-OVS stand beside them.
        kept: Keeps answers for pictures; None: nothing is kept.

    Raises:
        ValueError: If labels name what `Scene.classes` does not have or differ in size from the view.
    """
    headline = _resolve(protocol, scene)
    prompts, reason = prompts_of(scene, query, text)
    if not field.has_language:
        prompts, reason = None, NO_LANGUAGE
    gaussians, per_view = gaussians_of(field), {}
    kept = KeptAnswers() if kept is None else kept
    tally = splats = None
    histogram = Histogram(scene.classes, scene.class_kinds)
    if prompts is not None:
        tally = LanguageTally(query, prompts, headline)
        if gaussians is not None:
            splats = SplatAnswers(gaussians, query, prompts)
    for view in scene.test:
        answer = kept.answer(field, view.camera, prompts)
        per_view[view.name] = _image_scores(view, answer)
        if gaussians is not None:
            histogram.add(view, gaussians[0])
        if tally is not None:
            tally.add(view, answer, partial(splats.seen_by, view.camera) if splats else None)
    if tally is not None:
        language = tally.conclude(scene.class_kinds)
    else:
        language = LanguageScores(None, None, {}, {}, {"miou": reason, "loc_acc": reason}, {})
    asked = not isinstance(protocol, Auto) or (prompts is not None and _is_labelled(scene))
    asked = asked and field.has_language
    evaluation = _conclude(scene, tag(headline, scene.split), per_view, language, asked)
    if gaussians is None or not field.has_language:
        why = NO_GAUSSIANS if gaussians is None else NO_LANGUAGE
        return replace(evaluation, reasons={**evaluation.reasons, "indicator": why})
    return replace(evaluation, indicator=histogram.shares())


def _resolve(protocol: EvaluationProtocol | Auto, scene: Scene) -> EvaluationProtocol:
    if not isinstance(protocol, Auto):
        return protocol
    return DENSE if any(view.read_dense_labels is not None for view in scene.test) else LERF_OVS


def _is_labelled(scene: Scene) -> bool:
    return any(view.read_dense_labels or view.read_object_labels for view in scene.test)


def prompts_of(scene: Scene, query: Query, text: TextEncoder | None) -> tuple[Prompts | None, str]:
    """The scene's classes, encoded, or None and the reason why there are none."""
    if not scene.classes:
        return None, "the scene has no labels"
    if text is None:
        return None, "no language was trained, or there is no vocabulary"
    try:
        return encode_prompts(query, text, scene.classes), ""
    except (ValueError, FileNotFoundError, ImportError) as error:
        return None, str(error)


def _image_scores(view: View, answer: Answer) -> dict[str, float | None]:
    photograph = view.read_image().to(answer.color.dtype) / 255
    valid = view.read_valid() if view.read_valid is not None else None
    return {
        "psnr": image.psnr(answer.color, photograph, valid),
        "ssim": image.ssim(answer.color, photograph, valid),
        "ssim_3dgs": image.ssim(answer.color, photograph, valid, border="zero"),
    }


def _conclude(
    scene: Scene,
    name: str,
    per_view: dict[str, dict[str, float | None]],
    language: LanguageScores,
    asked: bool,
) -> Evaluation:
    psnr, ssim, ssim_3dgs = (
        mean_of_known(scores[metric] for scores in per_view.values())
        for metric in ("psnr", "ssim", "ssim_3dgs")
    )
    reasons = {**language.reasons, "lpips": image.NO_LPIPS}
    if psnr is None:
        reasons["psnr"] = reasons["ssim"] = (
            "no held-out pixel is valid" if scene.test else "there are no held-out views"
        )
    failure = None
    if asked and language.miou is None:
        failure = f"{name}: nothing could be scored, {reasons['miou']}"
    trained = {view.name for view in scene.train}
    labels = [f"labels={scene.label_set}"] if scene.label_set else []
    return Evaluation(
        protocol=" ".join([name, *labels]),
        psnr=psnr,
        ssim=ssim,
        miou=language.miou,
        loc_acc=language.loc_acc,
        per_category=language.per_category,
        category_kinds={c: k for c, k in scene.class_kinds.items() if c in language.per_category},
        per_view=per_view,
        beside={
            **language.beside,
            "ssim_3dgs": ssim_3dgs,
            "lpips": None,
            "test_views": len(scene.test),
            "test_views_seen": sum(view.name in trained for view in scene.test),
        },
        reasons=reasons,
        failure=failure,
        queries=query_rows(language.queries, scene),
    )


def query_rows(
    queries: Mapping[EvaluationProtocol, Sequence[QueryScore]], scene: Scene
) -> list[dict[str, str | int | float | bool | None]]:
    """One flat row per protocol, view and category, as `RunFolder.queries` keeps them."""
    return [
        {
            "protocol": tag(protocol, scene.split),
            "view": score.view,
            "category": score.category,
            "kind": scene.class_kinds.get(score.category),
            "iou": score.iou,
            "boundary_iou": score.boundary_iou,
            "hit": score.hit,
            "level": score.level,
            "both_pixels": score.both,
            "selected_pixels": score.selected,
            "true_pixels": score.true,
            "pixels": score.pixels,
        }
        for protocol, scores in queries.items()
        for score in scores
    ]
