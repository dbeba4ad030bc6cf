"""The LERF-OVS protocol as LangSplat released it: segmentation and localisation of one prompt in one view (systems.md B.1).

A unit is one category in one labelled view. Its relevancy comes at one or several mask levels; segmentation and localisation
choose a level each, by the largest smoothed value, without looking at the labels. Scene figures are means over units.

Two forms exist. The released one counts localisation as a hit if *any* pixel that attains the maximum lies in a box, so that a
constant map always hits. The strict one looks at the first maximum only, in reading order, and a constant map is no hit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vlgs.metrics.mean import mean_of_known

NAME = "lerf_ovs"
VERSION = 1


@dataclass(frozen=True)
class Constants:
    """The protocol's numbers; LangSplat's are the default (systems.md B.1, B.2)."""

    box: int = 30
    """Side of the smoothing window in pixels; an even one reaches one pixel further up and left."""
    blend: float = 0.5
    """Share of the smoothed map in the map that is segmented."""
    threshold: float = 0.4
    """Applied after the min-max step and 2 n - 1, so 0.4 selects the top 30 % of the range."""
    vote: int = 7
    """Side of the majority window in pixels, odd."""


LANGSPLAT = Constants()


@dataclass(frozen=True)
class Unit:
    """The truth of one category in one view."""

    category: str
    mask: Bool[Tensor, "h w"]
    """Union of the instances."""
    boxes: Float[Tensor, "b 4"] | None = None
    """``(x1, y1, x2, y2)`` per instance, edges inclusive; None where there are none: then a hit is a pixel of the mask."""


@dataclass(frozen=True)
class UnitScore:
    """What one unit adds to the figures of a scene."""

    category: str
    iou: float | None
    """None if the unit's mask is empty: nothing can be scored."""
    hit: bool | None
    """Localisation as released; None if the unit has neither a box nor a mask pixel."""
    hit_strict: bool | None
    """Localisation in the strict form."""


@dataclass(frozen=True)
class SceneScore:
    """Figures over all units of a scene; None is not available."""

    miou: float | None
    loc_acc: float | None
    hits: int
    located: int
    """Units that localisation was scored on."""
    units: int
    per_category: Mapping[str, float | None]
    """Mean IoU over the units of a category."""


def score_unit(
    relevancy: Float[Tensor, "levels h w"],
    unit: Unit,
    constants: Constants = LANGSPLAT,
) -> UnitScore:
    """Score the relevancy of one prompt in one view.

    Args:
        relevancy: One map per mask level; a single level is fine.
        unit: Labels of the same size.
        constants: The protocol's numbers.

    Raises:
        ValueError: If sizes differ, there is no level, or the relevancy is not finite.
    """
    if relevancy.shape[0] == 0 or relevancy.shape[1:] != unit.mask.shape:
        raise ValueError(
            f"lerf_ovs: relevancy of {unit.category!r} must be [levels >= 1, {', '.join(map(str, unit.mask.shape))}] "
            f"like its mask, got {list(relevancy.shape)}"
        )
    if not relevancy.isfinite().all():
        raise ValueError(f"lerf_ovs: relevancy of {unit.category!r} must be finite, got NaN or inf")
    smooth = box_mean(relevancy, constants.box)
    blended = constants.blend * smooth + (1 - constants.blend) * relevancy
    best = blended[blended.flatten(1).amax(dim=1).argmax()]
    located = smooth[smooth.flatten(1).amax(dim=1).argmax()]
    return UnitScore(
        unit.category,
        intersection_over_union(segment(best, constants), unit.mask),
        localise(located, unit),
        localise(located, unit, strict=True),
    )


def segment(blended: Float[Tensor, "h w"], constants: Constants = LANGSPLAT) -> Bool[Tensor, "h w"]:
    """Pixels that a prompt selects: min-max, 2 n - 1, clip, threshold, majority vote. A constant map selects none."""
    shifted = blended - blended.min()
    stretched = 2 * shifted / (shifted.max() + 1e-9) - 1
    return majority_vote(stretched.clamp(0, 1) > constants.threshold, constants.vote)


def localise(smooth: Float[Tensor, "h w"], unit: Unit, strict: bool = False) -> bool | None:
    """Whether the maximum of a smoothed map lies on the unit; None if the unit has neither boxes nor mask pixels."""
    if unit.boxes is None and not unit.mask.any():
        return None
    if strict and smooth.max() == smooth.min():
        return False
    y, x = torch.nonzero(smooth == smooth.max(), as_tuple=True)
    if strict:
        y, x = y[:1], x[:1]
    if unit.boxes is None:
        return bool(unit.mask[y, x].any())
    left, right = unit.boxes[:, 0::2].aminmax(dim=1)
    top, bottom = unit.boxes[:, 1::2].aminmax(dim=1)
    inside_x = (x[:, None] >= left) & (x[:, None] <= right)  # [maxima, b]
    return bool((inside_x & (y[:, None] >= top) & (y[:, None] <= bottom)).any())


def scene_score(scores: Sequence[UnitScore], strict: bool = False) -> SceneScore:
    """Means over units, not over categories or views; what could not be scored is left out.

    Args:
        scores: Of all units of a scene.
        strict: Take the strict form of localisation.
    """
    located = [score.hit_strict if strict else score.hit for score in scores]
    hits = [hit for hit in located if hit is not None]
    by_category: dict[str, list[UnitScore]] = {}
    for score in scores:
        by_category.setdefault(score.category, []).append(score)
    return SceneScore(
        miou=mean_of_known([score.iou for score in scores]),
        loc_acc=mean_of_known([float(hit) for hit in hits]),
        hits=sum(hits),
        located=len(hits),
        units=len(scores),
        per_category={c: mean_of_known([s.iou for s in units]) for c, units in by_category.items()},
    )


def intersection_over_union(
    prediction: Bool[Tensor, "h w"], truth: Bool[Tensor, "h w"]
) -> float | None:
    """IoU of two masks; None if the truth is empty, 0 if only the prediction is."""
    if not truth.any():
        return None
    return (prediction & truth).sum().item() / (prediction | truth).sum().item()


def box_mean(maps: Float[Tensor, "b h w"], size: int) -> Float[Tensor, "b h w"]:
    """Mean over a square window, as OpenCV's ``filter2D`` with its default anchor and border.

    The window of an even size s reaches from -s/2 to s/2 - 1; the border mirrors without repeating the edge. Summed areas in
    float64 make the cost independent of the size; rounding back to the input's precision restores the ties of equal windows.
    """
    mean = _window_mean(_window_mean(maps.double(), size).mT, size).mT
    return mean.to(maps.dtype)


def majority_vote(mask: Bool[Tensor, "h w"], size: int) -> Bool[Tensor, "h w"]:
    """Majority over a square window of odd size, ties to False.

    The released code clips the end of each window to ``h - 1`` and ``w - 1`` exclusively, so the last row and column never
    vote. That is kept: it is part of every published number.
    """
    h, w = mask.shape
    sums = torch.nn.functional.pad(
        mask.cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32), (1, 0, 1, 0)
    )  # sums[y, x] = votes above and left
    top, bottom = _vote_range(h, size)
    left, right = _vote_range(w, size)
    votes = (
        sums[bottom][:, right] - sums[top][:, right] - sums[bottom][:, left] + sums[top][:, left]
    )
    return 2 * votes > (bottom - top)[:, None] * (right - left)


def _window_mean(maps: Float[Tensor, "b h w"], size: int) -> Float[Tensor, "b h w"]:
    n = maps.shape[-1]
    index = torch.arange(-(size // 2), n + (size - 1) // 2)
    period = max(2 * (n - 1), 1)  # mirrored as often as needed, so that windows may exceed the map
    index = index.remainder(period)
    index = torch.minimum(index, period - index).clamp_max(n - 1)
    sums = torch.nn.functional.pad(maps[..., index].cumsum(dim=-1), (1, 0))
    return (sums[..., size:] - sums[..., :-size]) / size


def _vote_range(n: int, size: int) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    at, half = torch.arange(n), size // 2
    return (at - half).clamp_min(0).clamp_max(n - 1), (at + half + 1).clamp_max(n - 1)
