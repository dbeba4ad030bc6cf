"""Which protocol gives a run its headline numbers."""

from dataclasses import dataclass
from typing import Literal

from vlgs.metrics import dense, lerf_ovs

Headline = Literal["dense", "lerf_ovs"]


@dataclass(frozen=True)
class EvaluationProtocol:
    """What `miou` and `loc_acc` of a result mean. Scores of the other protocol stand beside them under their own names.

    Args:
        headline: ``dense``, ``lerf_ovs``, or ``auto``: dense where the held-out views have a class for every pixel.
        strict: Score LERF-OVS localisation by its first maximum only, and never a constant map (pitfalls.md finding 8).

    Raises:
        ValueError: If the headline is none of these.
    """

    headline: Literal["auto", "dense", "lerf_ovs"] = "auto"
    strict: bool = False

    def __post_init__(self) -> None:
        if self.headline not in ("auto", "dense", "lerf_ovs"):
            raise ValueError(
                f"protocol: headline must be auto, dense or lerf_ovs, got {self.headline!r}"
            )

    def resolve(self, has_dense_labels: bool) -> Headline:
        """The protocol of the headline for a scene."""
        if self.headline == "auto":
            return "dense" if has_dense_labels else "lerf_ovs"
        return self.headline

    def tag(self, headline: Headline) -> str:
        """Name and version as they go into a result, such as ``lerf_ovs-strict@1``."""
        if headline == "dense":
            return f"{dense.NAME}@{dense.VERSION}"
        return f"{lerf_ovs.NAME}{'-strict' if self.strict else ''}@{lerf_ovs.VERSION}"
