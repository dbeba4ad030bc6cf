"""Language scores, gathered view by view: by the chosen protocol, by two others for comparison, and what exact features score."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vlgs.fields.similarity import cosines
from vlgs.metrics.dense import Dense
from vlgs.metrics.lerf_ovs import LerfOvs
from vlgs.metrics.masks import QueryScore
from vlgs.metrics.mean import mean_of_known
from vlgs.metrics.protocol import (
    EvaluationProtocol,
    Evidence,
    Figures,
    GaussianEvidence,
    NotScorableError,
)
from vlgs.queries import Prompts, Query
from vlgs.report.answer import Answer
from vlgs.report.labels import read_truth, read_units
from vlgs.types import IGNORE_ID, View

DENSE, LERF_OVS = Dense(), LerfOvs()
"""Beside every headline, with their published numbers."""


@dataclass(frozen=True)
class LanguageScores:
    """Headline figures, those beside them, every query, and what stood in the way."""

    miou: float | None
    loc_acc: float | None
    per_category: Mapping[str, float | None]
    beside: Mapping[str, float | int | None]
    reasons: Mapping[str, str]
    queries: Mapping[EvaluationProtocol, Sequence[QueryScore]]


class LanguageTally:
    """Adds up views; `conclude` turns the sums into figures.

    Args:
        query: How relevancy is computed.
        prompts: The scene's classes, encoded.
        headline: The protocol of `miou` and `loc_acc`.
    """

    def __init__(
        self, query: Query, prompts: Prompts, headline: EvaluationProtocol = DENSE
    ) -> None:
        self.query = query
        self.prompts = prompts
        self.headline = headline
        # A headline that equals one of the two is scored once.
        self.scores: dict[EvaluationProtocol, list[QueryScore]] = {
            protocol: [] for protocol in (headline, DENSE, LERF_OVS)
        }
        self.reasons: dict[EvaluationProtocol, str] = {}
        """Why a protocol cannot score this scene at all."""
        self.ceilings: dict[EvaluationProtocol, list[QueryScore]] = {DENSE: [], LERF_OVS: []}

    def add(
        self,
        view: View,
        answer: Answer,
        splats: Callable[[], GaussianEvidence] | None = None,
    ) -> None:
        """Score one view against its labels; a view without labels adds nothing.

        Args:
            view: Whose labels count.
            answer: With the prompts.
            splats: The Gaussians, for protocols that select in 3D; None where there are none.

        Raises:
            ValueError: If labels name unknown classes or differ in size from the view.
        """
        truth = read_truth(view)
        units = read_units(view, self.prompts.names, truth)
        if truth is None and not units:
            return
        assert answer.cosines is not None  # there are prompts
        assert answer.negatives is not None
        asked = answer.cosines.unbind()
        relevancy = list(map(self.query.relevancy, asked, answer.negatives.unbind()))
        seen = Evidence(view.name, self.prompts.names, units, truth, asked, relevancy, splats)
        for protocol, scores in self.scores.items():
            try:
                scores += protocol.score(seen)
            except NotScorableError as error:
                self.reasons[protocol] = str(error)
        if truth is not None:
            exact = [self._exact_relevancy(truth)]
            best = replace(seen, cosines=exact, relevancy=exact)
            for protocol, scores in self.ceilings.items():
                scores += protocol.score(best)

    def conclude(self, kinds: Mapping[str, str]) -> LanguageScores:
        """Figures over all views.

        Args:
            kinds: Category -> kind; adds one mean over the categories of each kind.
        """
        headline = self._figures(self.headline, self.scores)
        beside = self._beside() | dict(headline.more) | _by_kind(headline.per_category, kinds)
        # Faults of the object labels concern the figures beside a dense headline too.
        reasons = dict(headline.reasons)
        labels = self._figures(LERF_OVS, self.scores).reasons.get("labels")
        if labels is not None:
            reasons["labels"] = labels
        return LanguageScores(
            headline.miou, headline.loc_acc, headline.per_category, beside, reasons, self.scores
        )

    def _beside(self) -> dict[str, float | int | None]:
        dense, lerf = (self._figures(protocol, self.scores) for protocol in (DENSE, LERF_OVS))
        dense_ceiling, ceiling = (
            self._figures(protocol, self.ceilings) for protocol in (DENSE, LERF_OVS)
        )
        return {
            "loc_acc_dense": dense.loc_acc,
            "loc_acc_dense_ceiling": dense_ceiling.loc_acc,
            "miou_dense": dense.miou,
            "miou_dense_present": dense.more["miou_dense_present"],
            "pixel_accuracy": dense.more["pixel_accuracy"],
            "miou_lerf_ovs": lerf.miou,
            "loc_acc_lerf_ovs": lerf.loc_acc,
            "miou_lerf_ovs_ceiling": ceiling.miou,
            "loc_acc_lerf_ovs_ceiling": ceiling.loc_acc,
            "hits_lerf_ovs": lerf.more["hits"],
            "units_lerf_ovs": lerf.more["units"],
        }

    def _figures(
        self,
        protocol: EvaluationProtocol,
        scores: Mapping[EvaluationProtocol, Sequence[QueryScore]],
    ) -> Figures:
        if protocol in self.reasons:
            why = self.reasons[protocol]
            return Figures(None, None, {}, reasons={"miou": why, "loc_acc": why})
        return protocol.conclude(scores[protocol], self.prompts.names)

    def _exact_relevancy(self, truth: UInt8[Tensor, "h w"]) -> Float[Tensor, "k h w"]:
        """Relevancy if every pixel carried the text vector of its true class; pixels to ignore carry none."""
        text = self.prompts.text
        carried = torch.cat([text, torch.zeros_like(text[:1])])
        relevancy = self.query.relevancy(
            cosines(carried, text), cosines(carried, self.prompts.negatives)
        )  # [k, k + 1]
        return relevancy[:, truth.long().masked_fill(truth == IGNORE_ID, len(text))]


def _by_kind(
    per_category: Mapping[str, float | None], kinds: Mapping[str, str]
) -> dict[str, float | int | None]:
    """``miou_<kind>``: the mean over the categories of a kind, as in the paper's per-category tables."""
    return {
        f"miou_{kind}": mean_of_known([v for c, v in per_category.items() if kinds.get(c) == kind])
        for kind in sorted(set(kinds.values()))
    }
