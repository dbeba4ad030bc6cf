"""Pictures of one held-out view: photograph, renders and answers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vlgs.fields import Field, HasGaussians
from vlgs.metrics.dense import predict_classes
from vlgs.metrics.masks import Unit
from vlgs.metrics.segment import blend, segment, smooth
from vlgs.queries import Prompts, Query
from vlgs.report import colors
from vlgs.report.answer import Answer, KeptAnswers
from vlgs.report.features import FeatureColors, fit_feature_colors, paint_features
from vlgs.report.indicator import indicator_difference
from vlgs.report.labels import read_truth, read_units
from vlgs.types import IGNORE_ID, Scene, View


@dataclass(frozen=True)
class PromptPictures:
    """The answer to one prompt in one view."""

    relevancy: UInt8[Tensor, "h w 3"]
    """Heat map over the photograph, from the map's minimum to its maximum."""
    segmentation: UInt8[Tensor, "h w 3"]
    """Selected pixels, with the outline of the truth."""


@dataclass(frozen=True)
class ViewPictures:
    """Everything drawn for one view."""

    name: str
    photograph: UInt8[Tensor, "h w 3"]
    render: UInt8[Tensor, "h w 3"]
    features: UInt8[Tensor, "h w 3"] | None = None
    """None where no language was trained, or the field renders no features."""
    difference: UInt8[Tensor, "h w 3"] | None = None
    """l - o as seen from the view (Fig. 3); None where `Painter.has_difference` is false."""
    labels: UInt8[Tensor, "h w 3"] | None = None
    """True classes, where the view has one for every pixel."""
    prediction: UInt8[Tensor, "h w 3"] | None = None
    """Class with the largest cosine."""
    classes: tuple[int, ...] = ()
    """Ids that occur in `labels` or `prediction`."""
    prompts: Mapping[str, PromptPictures] = field(default_factory=dict)
    """By prompt, the most telling first."""
    words: Mapping[str, UInt8[Tensor, "h w 3"]] = field(default_factory=dict)
    """Heat maps of words that are asked where nobody labelled the scene, each from its lowest to its highest in all views."""


class Painter:
    """Draws views of one trained scene; feature colours mean the same in all of them.

    Args:
        field: The trained scene; of several mask levels the last, of whole objects, is drawn.
        scene: Its held-out views and labels.
        query: How relevancy is computed.
        prompts: The scene's classes, encoded, or words for a scene without any; without either there is nothing to answer.
        views: The views whose features set the colours, usually those that will be drawn.
        kept: Answers that scores were made from; None: all are made here.
    """

    @torch.no_grad()
    def __init__(
        self,
        field: Field,
        scene: Scene,
        query: Query,
        prompts: Prompts | None,
        views: Sequence[View],
        kept: KeptAnswers | None = None,
    ) -> None:
        self.kept = KeptAnswers() if kept is None else kept
        self.field, self.scene, self.query, self.prompts = field.levels()[-1], scene, query, prompts
        self.gaussians = self.field if isinstance(self.field, HasGaussians) else None
        self.has_language = len(scene.mask_vectors) > 0
        self.has_difference = self.has_language and _differ(self.gaussians)
        """Whether l - o is drawn: not where the field has no Gaussians, or l is o in all of them."""
        self.feature_colors = self._feature_colors(views)
        self.times_asked = dict.fromkeys(scene.classes, 0)
        self.ranges = None if scene.classes or prompts is None else self._ranges(views)

    @torch.no_grad()
    def draw(self, view: View, max_prompts: int) -> ViewPictures:
        """All pictures of one view; prompts that other views have shown less often come first."""
        answer = self.kept.answer(self.field, view.camera, self.prompts)
        pictures = ViewPictures(
            name=view.name,
            photograph=view.read_image(),
            render=colors.to_uint8(answer.color),
        )
        if self.feature_colors is not None and answer.feature is not None:
            shown = paint_features(answer.feature[0], self.feature_colors)
            pictures = replace(pictures, features=shown)
        if self.has_difference and self.gaussians is not None:
            difference = indicator_difference(self.gaussians, view.camera)
            pictures = replace(pictures, difference=colors.diverging(difference))
        if self.prompts is None:
            return pictures
        if self.ranges is not None:
            return self._add_words(pictures, answer, self.ranges)
        truth = read_truth(view)
        units = self._choose(read_units(view, self.prompts.names, truth), max_prompts)
        prompts = self._answer_prompts(answer, pictures.photograph, units)
        pictures = replace(pictures, prompts=prompts)
        return pictures if truth is None else self._add_classes(pictures, answer, truth)

    def _feature_colors(self, views: Sequence[View]) -> FeatureColors | None:
        """None where there are no features to show."""
        feature = frozenset({"feature"})
        if not self.has_language or not feature <= self.field.outputs:
            return None
        seen = (self.field.render(view.camera, feature).feature for view in views)
        return fit_feature_colors(image[0] for image in seen if image is not None)

    def _choose(self, units: Sequence[Unit], count: int) -> list[Unit]:
        """Prompts that tell most: rarely asked before, then of neither tiny nor view-filling objects, then glass and mirrors."""

        def rank(unit: Unit) -> tuple[bool, int, bool, str]:
            share = unit.mask.float().mean().item()
            special = self.scene.class_kinds.get(unit.category) == "translucent_reflective"
            telling = 0.003 <= share <= 0.25
            return not telling, self.times_asked[unit.category], not special, unit.category

        chosen = sorted(units, key=rank)[:count]
        for unit in chosen[:1]:  # the first is what the overview shows
            self.times_asked[unit.category] += 1
        return chosen

    def _answer_prompts(
        self, answer: Answer, photograph: UInt8[Tensor, "h w 3"], units: Sequence[Unit]
    ) -> dict[str, PromptPictures]:
        assert self.prompts is not None
        rows = [self.prompts.names.index(unit.category) for unit in units]
        pictures = {}
        for unit, blended in zip(units, self._blended(answer, rows), strict=True):
            pictures[unit.category] = PromptPictures(
                relevancy=colors.heat_over(photograph, colors.stretch(blended)),
                segmentation=colors.mask_over(photograph, segment(blended), unit.mask),
            )
        return pictures

    def _blended(self, answer: Answer, rows: Sequence[int]) -> Float[Tensor, "r h w"]:
        """Relevancy of some prompts as LERF-OVS segments it."""
        assert answer.cosines is not None  # there are prompts
        assert answer.negatives is not None
        relevancy = self.query.relevancy(answer.cosines[0], answer.negatives[0])[list(rows)]
        return blend(relevancy, smooth(relevancy))

    def _ranges(self, views: Sequence[View]) -> Float[Tensor, "2 k"]:
        """Lowest and highest relevancy of each word in all views: where it is not seen its map stays cold."""
        assert self.prompts is not None
        rows, bounds = range(len(self.prompts.names)), []
        for view in views:
            answer = self.kept.answer(self.field, view.camera, self.prompts)
            bounds.append(torch.stack(self._blended(answer, rows).flatten(1).aminmax(dim=1)))
        low, high = torch.stack(bounds).unbind(dim=1)  # [views, k] each
        return torch.stack([low.amin(dim=0), high.amax(dim=0)])

    def _add_words(
        self, pictures: ViewPictures, answer: Answer, ranges: Float[Tensor, "2 k"]
    ) -> ViewPictures:
        """A heat map for each word, and the best of them for every pixel."""
        assert self.prompts is not None
        assert answer.cosines is not None  # there are prompts
        low, high = ranges[..., None, None]
        names = self.prompts.names
        shares = (self._blended(answer, range(len(names))) - low) / (high - low).clamp_min(1e-9)
        words = {
            word: colors.heat_over(pictures.photograph, share)
            for word, share in zip(names, shares, strict=True)
        }
        best = predict_classes(answer.cosines.unbind())
        return replace(
            pictures,
            words=words,
            prediction=colors.paint_labels(best, len(words)),
            classes=tuple(best.unique().tolist()),
        )

    def _add_classes(
        self, pictures: ViewPictures, answer: Answer, truth: UInt8[Tensor, "h w"]
    ) -> ViewPictures:
        assert self.prompts is not None
        assert answer.cosines is not None  # there are prompts
        count = len(self.prompts.names)
        prediction = predict_classes(answer.cosines.unbind())
        shown = {*truth.unique().tolist(), *prediction.unique().tolist()} - {IGNORE_ID}
        return replace(
            pictures,
            labels=colors.paint_labels(truth, count),
            prediction=colors.paint_labels(prediction, count),
            classes=tuple(sorted(shown)),
        )


def _differ(gaussians: HasGaussians | None) -> bool:
    """Whether some Gaussian's language is blended by another weight than its colour."""
    if gaussians is None:
        return False
    return not torch.equal(gaussians.language_weights(), gaussians.opacities())
