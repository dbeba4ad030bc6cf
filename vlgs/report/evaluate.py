"""Scores of a trained scene on its held-out views."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from vlgs.metrics import image
from vlgs.metrics.mean import mean_of_known
from vlgs.metrics.protocol import EvaluationProtocol
from vlgs.query import Prompts, Query, TextEncoder, encode_prompts
from vlgs.report.answer import Answer, ViewModel, answer_view
from vlgs.report.language import LanguageScores, LanguageTally
from vlgs.types import Scene, View


@dataclass(frozen=True)
class Evaluation:
    """Scores of one run. None is not available, and `reasons` says why; it is never 0 or 1 by default."""

    protocol: str
    """Name and version of the headline's protocol and the split, such as ``dense@1 split=synthetic``."""
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
    """Metric -> why it is not available; faults of the labels stand under ``labels``."""


@torch.no_grad()
def evaluate(
    model: ViewModel,
    scene: Scene,
    query: Query,
    text: TextEncoder | None,
    protocol: EvaluationProtocol,
) -> Evaluation:
    """Render every held-out view once and score colour and language.

    Dense labels give the dense scores; localisation beside them is the strict form. Units of LERF-OVS come from object labels
    where a view has them, otherwise one per class that its dense labels show: such a unit has no box, and a hit is a pixel of
    its mask. The ceiling is what LERF-OVS gives to exact features, where every pixel carries the text vector of its true class.

    Args:
        model: The trained scene.
        scene: Its held-out views, labels and classes.
        query: Relevancy for LERF-OVS; the dense protocol needs none.
        text: Encodes `Scene.classes`. Without it, or if it lacks a word, there are no language scores, and the reason is given.
        protocol: Which scores are the headline.

    Raises:
        ValueError: If labels name what `Scene.classes` does not have, or differ in size from the view.
    """
    prompts, reason = prompts_of(scene, query, text)
    tally = LanguageTally(query, prompts) if prompts is not None else None
    fused, per_view = model.fuse(), {}
    for view in scene.test:
        answer = answer_view(model, view.camera, prompts, fused)
        per_view[view.name] = _image_scores(view, answer)
        if tally is not None:
            tally.add(view, answer)
    headline = protocol.resolve(any(view.read_dense_labels is not None for view in scene.test))
    if tally is not None:
        language = tally.conclude(headline, protocol.strict, scene.class_kinds)
    else:
        language = LanguageScores(None, None, {}, {}, {"miou": reason, "loc_acc": reason})
    return _conclude(scene, protocol.tag(headline), per_view, language)


def prompts_of(scene: Scene, query: Query, text: TextEncoder | None) -> tuple[Prompts | None, str]:
    """The scene's classes, encoded, or None and the reason why there are none."""
    if not scene.classes:
        return None, "the scene names no classes"
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
    }


def _conclude(
    scene: Scene,
    tag: str,
    per_view: dict[str, dict[str, float | None]],
    language: LanguageScores,
) -> Evaluation:
    psnr, ssim = (
        mean_of_known(scores[metric] for scores in per_view.values()) for metric in ("psnr", "ssim")
    )
    reasons = dict(language.reasons)
    if psnr is None:
        reasons["psnr"] = reasons["ssim"] = (
            "no held-out pixel is valid" if scene.test else "there are no held-out views"
        )
    trained = {view.name for view in scene.train}
    labels = [f"labels={scene.label_set}"] if scene.label_set else []
    return Evaluation(
        protocol=" ".join([tag, *labels, f"split={scene.split}"]),
        psnr=psnr,
        ssim=ssim,
        miou=language.miou,
        loc_acc=language.loc_acc,
        per_category=language.per_category,
        per_view=per_view,
        beside={
            **language.beside,
            "test_views": len(scene.test),
            "test_views_seen": sum(view.name in trained for view in scene.test),
        },
        reasons=reasons,
    )
