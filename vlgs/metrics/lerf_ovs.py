"""The LERF-OVS protocol as LangSplat released it: segmentation and localisation of one prompt in one view.

The source is ``eval/evaluate_iou_loc.py`` of minghanqin/LangSplat; `vlgs.metrics.segment` and `vlgs.metrics.smooth` hold its steps.

A query is one category in one labelled view. Its relevancy comes at one or several mask levels; segmentation and localisation
choose a level each, by the largest smoothed value, without looking at the labels. Scene figures are means over queries, not over
categories or views. A class that a view does not show is not asked for there, so a stray pixel of it costs nothing.

Two forms exist. The released one (``lerf_ovs``) counts localisation as a hit if *any* pixel that attains the maximum lies in a
box, so that a constant map always hits. The strict one (``lerf_ovs_strict``) looks at the first maximum only, in reading order,
and a constant map is no hit; its segmentation is the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.metrics.masks import QueryScore, Unit, compare
from vlgs.metrics.protocol import Evidence, Figures, query_figures
from vlgs.metrics.segment import LANGSPLAT, Constants, blend, check_relevancy, segment, smooth

NAME = "lerf_ovs"
VERSION = 1


@dataclass(frozen=True)
class LerfOvs:
    """LangSplat's protocol for LERF-OVS.

    Args:
        constants: Its numbers.
        strict: Score localisation by the first maximum only, and never a constant map.
    """

    constants: Constants = LANGSPLAT
    strict: bool = False

    @property
    def name(self) -> str:
        """``lerf_ovs`` or ``lerf_ovs_strict``."""
        return f"{NAME}_strict" if self.strict else NAME

    @property
    def version(self) -> int:
        """Raised when a change can move a number."""
        return VERSION

    def score(self, seen: Evidence) -> list[QueryScore]:
        """Score every labelled object of a view.

        Raises:
            ValueError: If sizes differ or the relevancy is not finite.
        """
        return [
            score_unit(
                seen.levels(seen.relevancy, unit), unit, self.constants, self.strict, seen.view
            )
            for unit in seen.units
        ]

    def conclude(self, scores: Sequence[QueryScore], classes: Sequence[str]) -> Figures:
        """Means over queries; what could not be scored is left out and named."""
        return query_figures(scores)


def score_unit(
    relevancy: Float[Tensor, "levels h w"],
    unit: Unit,
    constants: Constants = LANGSPLAT,
    strict: bool = False,
    view: str = "",
) -> QueryScore:
    """Score the relevancy of one prompt in one view.

    Args:
        relevancy: One map per mask level; a single level is fine.
        unit: Labels of the same size.
        constants: The protocol's numbers.
        strict: Which form of localisation.
        view: Name of the view, for the record.

    Raises:
        ValueError: If sizes differ, there is no level, or the relevancy is not finite.
    """
    check_relevancy(NAME, relevancy, unit.category)
    if relevancy.shape[1:] != unit.mask.shape:
        raise ValueError(
            f"lerf_ovs: relevancy of {unit.category!r} must be {list(unit.mask.shape)} like its mask, "
            f"got {list(relevancy.shape[1:])}"
        )
    smoothed = smooth(relevancy, constants)
    blended = blend(relevancy, smoothed, constants)
    level = int(blended.flatten(1).amax(dim=1).argmax())
    located = smoothed[smoothed.flatten(1).amax(dim=1).argmax()]
    return compare(
        view,
        unit,
        segment(blended[level], constants),
        hit=localise(located, unit, strict),
        level=level if len(relevancy) > 1 else None,
    )


def localise(smoothed: Float[Tensor, "h w"], unit: Unit, strict: bool = False) -> bool | None:
    """Whether the maximum of a smoothed map lies on the unit; None if the unit has neither boxes nor mask pixels."""
    if unit.boxes is None and not unit.mask.any():
        return None
    if strict and smoothed.max() == smoothed.min():
        return False
    y, x = torch.nonzero(smoothed == smoothed.max(), as_tuple=True)
    if strict:
        y, x = y[:1], x[:1]
    if unit.boxes is None:
        return bool(unit.mask[y, x].any())
    left, right = unit.boxes[:, 0::2].aminmax(dim=1)
    top, bottom = unit.boxes[:, 1::2].aminmax(dim=1)
    inside_x = (x[:, None] >= left) & (x[:, None] <= right)  # [maxima, b]
    return bool((inside_x & (y[:, None] >= top) & (y[:, None] <= bottom)).any())
