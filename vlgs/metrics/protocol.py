"""The interface of a protocol: a name, a version, a score for every query, and how the scores become figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vlgs.metrics.masks import QueryScore, Unit, by_category, mean_over_queries, share_hit


@dataclass(frozen=True)
class GaussianEvidence:
    """The scene in 3D, for protocols that select Gaussians instead of pixels."""

    relevancy: Sequence[Float[Tensor, "k n"]]
    """Per level: relevancy of each class for each Gaussian."""
    silhouette: Callable[[int, Bool[Tensor, " n"]], Float[Tensor, "h w"]]
    """Level and selected Gaussians -> accumulated weight of these alone, seen from the view."""


@dataclass(frozen=True)
class Evidence:
    """What a trained scene says about one labelled view, and the truth. Sequences have one entry per mask level."""

    view: str
    classes: tuple[str, ...]
    units: Sequence[Unit]
    """Objects that can be asked for in this view."""
    truth: UInt8[Tensor, "h w"] | None
    """Class id of every pixel, where the view has it."""
    cosines: Sequence[Float[Tensor, "k h w"]]
    """Of every class."""
    relevancy: Sequence[Float[Tensor, "k h w"]]
    """Of every class under the query."""
    splats: Callable[[], GaussianEvidence] | None = None
    """Computed when a protocol asks for it; None where the scene is no Gaussians."""

    def levels(self, maps: Sequence[Float[Tensor, "k h w"]], unit: Unit) -> Float[Tensor, "l h w"]:
        """The maps of one unit's category at all levels.

        Raises:
            ValueError: If the maps differ in size from the unit's mask.
        """
        at = torch.stack([level[self.classes.index(unit.category)] for level in maps])
        if at.shape[1:] != unit.mask.shape:
            raise ValueError(
                f"evaluate: labels of view {self.view!r} must be as large as the view {list(at.shape[1:])}, "
                f"got {list(unit.mask.shape)}"
            )
        return at


@dataclass(frozen=True)
class Figures:
    """Figures of a scene by one protocol. None means not available; `reasons` says why."""

    miou: float | None
    loc_acc: float | None
    per_category: Mapping[str, float | None]
    more: Mapping[str, float | int | None] = field(default_factory=dict)
    """Further figures under names of their own."""
    reasons: Mapping[str, str] = field(default_factory=dict)


class NotScorableError(ValueError):
    """A protocol needs what the trained scene does not have: its figures are not available, for this reason."""


@runtime_checkable
class EvaluationProtocol(Protocol):
    """The interface of a protocol. Implementations are frozen dataclasses whose fields are the protocol's numbers."""

    @property
    def name(self) -> str:
        """The name in results and tables."""
        ...

    @property
    def version(self) -> int:
        """Raised when a change can move a number."""
        ...

    def score(self, seen: Evidence) -> list[QueryScore]:
        """Score one view; a view without the labels that the protocol needs adds nothing.

        Raises:
            NotScorableError: If the protocol needs what the trained scene does not have.
        """
        ...

    def conclude(self, scores: Sequence[QueryScore], classes: Sequence[str]) -> Figures:
        """Figures of a scene from the scores of all its views."""
        ...


@dataclass(frozen=True)
class Auto:
    """``dense`` where the held-out views have a class for every pixel, ``lerf_ovs`` otherwise; see `vlgs.report.evaluate`."""


def query_figures(scores: Sequence[QueryScore]) -> Figures:
    """Means over queries, as most protocols take them."""
    miou = mean_over_queries(scores, lambda score: score.iou)
    empty = [f"{score.category} in {score.view}" for score in scores if score.iou is None]
    reasons = {"labels": f"empty masks were left out: {', '.join(empty)}"} if empty else {}
    if miou is None:
        reasons["miou"] = reasons["loc_acc"] = "no held-out view has a labelled object"
    return Figures(
        miou=miou,
        loc_acc=share_hit(scores),
        per_category=by_category(scores),
        more={
            "boundary_iou": mean_over_queries(scores, lambda score: score.boundary_iou),
            "hits": sum(score.hit is True for score in scores),
            "units": sum(score.hit is not None for score in scores),
        },
        reasons=reasons,
    )


def without_localisation(name: str, scores: Sequence[QueryScore], **more: float | None) -> Figures:
    """`query_figures` of a protocol that defines no localisation, with further figures of its own."""
    figures = query_figures(scores)
    return replace(
        figures,
        loc_acc=None,
        more={"boundary_iou": figures.more["boundary_iou"], **more},
        reasons={**figures.reasons, "loc_acc": f"{name} defines no localisation"},
    )


def tag(protocol: EvaluationProtocol, split: str) -> str:
    """Name, version, split, and every number that is not the protocol's own: what tells two results apart.

    Example:
        >>> from vlgs.metrics.lerf_ovs import LerfOvs
        >>> from vlgs.metrics.segment import Constants
        >>> tag(LerfOvs(), "llff8"), tag(LerfOvs(constants=Constants(threshold=0.5)), "all")
        ('lerf_ovs@1/llff8', 'lerf_ovs@1[threshold=0.5]/all')
    """
    default = type(protocol)()
    changed = sorted(_settings(protocol).items() - _settings(default).items())
    said_by_name = {"strict", "form"}  # both are part of `name`
    settings = [f"{key}={_spell(value)}" for key, value in changed if key not in said_by_name]
    brackets = f"[{','.join(settings)}]" if settings else ""
    return f"{protocol.name}@{protocol.version}{brackets}/{split}"


def _settings(value: Any) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for part in fields(value):
        inner = getattr(value, part.name)
        flat |= _settings(inner) if is_dataclass(inner) else {part.name: inner}
    return flat


def _spell(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
