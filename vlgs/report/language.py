"""Language scores gathered view by view: the dense protocol, LERF-OVS and the ceiling of LERF-OVS."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vlgs.metrics import dense, lerf_ovs
from vlgs.metrics.mean import mean_of_known
from vlgs.metrics.protocol import Headline
from vlgs.query import Prompts, Query, cosines
from vlgs.report.answer import Answer
from vlgs.report.labels import read_truth, read_units
from vlgs.types import IGNORE_ID, View


@dataclass(frozen=True)
class LanguageScores:
    """Headline figures, those beside them, and what stood in the way."""

    miou: float | None
    loc_acc: float | None
    per_category: Mapping[str, float | None]
    beside: Mapping[str, float | int | None]
    reasons: Mapping[str, str]


class LanguageTally:
    """Adds up views; `conclude` turns the sums into figures.

    Args:
        query: Relevancy for LERF-OVS; the dense protocol needs none.
        prompts: The scene's classes, encoded.
    """

    def __init__(self, query: Query, prompts: Prompts) -> None:
        self.query = query
        self.prompts = prompts
        k = len(prompts.names)
        self.confusion = torch.zeros(k, k, dtype=torch.long)
        self.scores: list[lerf_ovs.UnitScore] = []
        self.ceiling: list[lerf_ovs.UnitScore] = []
        self.hits: list[bool] = []
        self.hits_ceiling: list[bool] = []
        self.unscored: list[str] = []

    def add(self, view: View, answer: Answer) -> None:
        """Score one view against its labels; a view without labels adds nothing.

        Raises:
            ValueError: If labels name unknown classes or differ in size from the view.
        """
        assert answer.cosines is not None  # there are prompts
        assert answer.negatives is not None
        truth = read_truth(view)
        units = read_units(view, self.prompts.names, truth)
        relevancy = self.query.relevancy(answer.cosines, answer.negatives)
        scores = self._score(relevancy, units)
        self.scores += scores
        self.unscored += [
            f"{score.category} in {view.name}" for score in scores if score.iou is None
        ]
        if truth is not None:
            prediction = dense.predict_classes(answer.cosines)
            self.confusion += dense.confusion(prediction, truth, len(self.prompts.names))
            exact = self._exact_relevancy(truth)
            self.ceiling += self._score(exact, units)
            self.hits += _located(relevancy, truth)
            self.hits_ceiling += _located(exact, truth)

    def conclude(
        self, headline: Headline, strict: bool, kinds: Mapping[str, str]
    ) -> LanguageScores:
        """Figures over all views.

        Args:
            headline: The protocol of `miou` and `loc_acc`.
            strict: Which form of LERF-OVS localisation is reported.
            kinds: Category -> kind; adds one mean over the categories of each kind.
        """
        ious = dense.class_iou(self.confusion)
        objects = lerf_ovs.scene_score(self.scores, strict)
        if headline == "dense":
            miou = mean_of_known(ious)
            loc_acc = _share(self.hits)
            per_category = dict(zip(self.prompts.names, ious, strict=True))
        else:
            miou, loc_acc, per_category = objects.miou, objects.loc_acc, objects.per_category
        return LanguageScores(
            miou=miou,
            loc_acc=loc_acc,
            per_category=per_category,
            beside=self._beside(objects, strict) | _by_kind(per_category, kinds),
            reasons=self._reasons(headline, miou, loc_acc),
        )

    def _beside(self, objects: lerf_ovs.SceneScore, strict: bool) -> dict[str, float | int | None]:
        ceiling = lerf_ovs.scene_score(self.ceiling, strict)
        return {
            "loc_acc_dense": _share(self.hits),
            "loc_acc_dense_ceiling": _share(self.hits_ceiling),
            "miou_dense": mean_of_known(dense.class_iou(self.confusion)),
            "pixel_accuracy": dense.pixel_accuracy(self.confusion),
            "miou_lerf_ovs": objects.miou,
            "loc_acc_lerf_ovs": objects.loc_acc,
            "miou_lerf_ovs_ceiling": ceiling.miou,
            "loc_acc_lerf_ovs_ceiling": ceiling.loc_acc,
            "hits_lerf_ovs": objects.hits,
            "units_lerf_ovs": objects.located,
        }

    def _reasons(
        self, headline: Headline, miou: float | None, loc_acc: float | None
    ) -> dict[str, str]:
        reasons = {}
        if miou is None:
            kind = "a class for any pixel" if headline == "dense" else "a labelled object"
            reasons["miou"] = f"no held-out view has {kind}"
        if loc_acc is None:
            reasons["loc_acc"] = "no held-out view has a labelled object"
        if self.unscored:
            reasons["labels"] = f"empty masks were left out: {', '.join(self.unscored)}"
        return reasons

    def _score(
        self, relevancy: Float[Tensor, "k h w"], units: list[lerf_ovs.Unit]
    ) -> list[lerf_ovs.UnitScore]:
        rows = {name: i for i, name in enumerate(self.prompts.names)}
        return [lerf_ovs.score_unit(relevancy[rows[unit.category]][None], unit) for unit in units]

    def _exact_relevancy(self, truth: UInt8[Tensor, "h w"]) -> Float[Tensor, "k h w"]:
        """Relevancy if every pixel carried the text vector of its true class; pixels to ignore carry none."""
        text = self.prompts.text
        carried = torch.cat([text, torch.zeros_like(text[:1])])
        relevancy = self.query.relevancy(
            cosines(carried, text), cosines(carried, self.prompts.negatives)
        )  # [k, k + 1]
        return relevancy[:, truth.long().masked_fill(truth == IGNORE_ID, len(text))]


def _located(relevancy: Float[Tensor, "k h w"], truth: UInt8[Tensor, "h w"]) -> list[bool]:
    """Localisation of every class that the view shows."""
    shown = [i for i in truth.unique().tolist() if i != IGNORE_ID]
    return [dense.localise(relevancy[i], truth == i) for i in shown]


def _share(hits: list[bool]) -> float | None:
    return sum(hits) / len(hits) if hits else None


def _by_kind(
    per_category: Mapping[str, float | None], kinds: Mapping[str, str]
) -> dict[str, float | int | None]:
    """``miou_<kind>``: the mean over the categories of a kind, as in the paper's per-category tables."""
    return {
        f"miou_{kind}": mean_of_known([v for c, v in per_category.items() if kinds.get(c) == kind])
        for kind in sorted(set(kinds.values()))
    }
