"""From a relevancy map to a mask, in the steps that LangSplat and its successors share, with the published constants of each."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.metrics.smooth import box_mean, majority_vote, pool_mean, pool_vote
from vlgs.values import require_range


@dataclass(frozen=True)
class Constants:
    """The numbers of a segmentation; ``eval/evaluate_iou_loc.py`` of LangSplat is the default.

    Raises:
        ValueError: If a number is out of its range.
    """

    window: Literal["filter2d", "pool"] = "filter2d"
    """How relevancy is smoothed: OpenCV's ``filter2D`` with mirrored borders, or a mean over the cells inside the image."""
    box: int = 30
    """Side of the smoothing window in pixels; with ``pool`` odd. An even one reaches one pixel further up and left."""
    blend: float = 0.5
    """Share of the smoothed map in the map that is segmented."""
    stretch: bool = True
    """Whether the min-max normalised map n becomes 2 n - 1 before the threshold, as the released code does it."""
    threshold: float = 0.4
    """Pixels above it are selected. With `stretch` 0.4 is the top 30 % of the range, without it the top 60 %."""
    vote: int = 7
    """Side of the majority window in pixels, odd; 1 for none but the edge rule."""
    vote_edge: Literal["clipped", "full"] = "clipped"
    """``clipped``: the last row and column never vote, as released. ``full``: they do."""

    def __post_init__(self) -> None:
        if self.window not in ("filter2d", "pool") or self.vote_edge not in ("clipped", "full"):
            raise ValueError(
                "protocol: window must be filter2d or pool and vote_edge clipped or full, got "
                f"{self.window!r} and {self.vote_edge!r}"
            )
        require_range("protocol", 1, 65536, box=self.box, vote=self.vote)
        if self.window == "pool" and self.box % 2 == 0:
            raise ValueError(
                f"protocol: box must be positive, and odd with window=pool, got {self.box}"
            )
        if self.vote % 2 == 0:
            raise ValueError(f"protocol: vote must be positive and odd, got {self.vote}")
        if not (0 <= self.blend <= 1 and 0 <= self.threshold < 1):
            raise ValueError(
                f"protocol: blend must be in [0, 1] and threshold in [0, 1), got {self.blend} and {self.threshold}"
            )


LANGSPLAT = Constants()
LANGSPLAT_V2 = Constants(window="pool", box=29, vote_edge="full")


def smooth(
    relevancy: Float[Tensor, "levels h w"], constants: Constants = LANGSPLAT
) -> Float[Tensor, "levels h w"]:
    """Relevancy averaged over the window."""
    mean = box_mean if constants.window == "filter2d" else pool_mean
    return mean(relevancy, constants.box)


def blend(
    relevancy: Float[Tensor, "levels h w"],
    smoothed: Float[Tensor, "levels h w"],
    constants: Constants = LANGSPLAT,
) -> Float[Tensor, "levels h w"]:
    """What is segmented: the raw map mixed with the smoothed one."""
    return constants.blend * smoothed + (1 - constants.blend) * relevancy


def segment(blended: Float[Tensor, "h w"], constants: Constants = LANGSPLAT) -> Bool[Tensor, "h w"]:
    """Pixels that a prompt selects: min-max, stretch, threshold, majority vote. A constant map selects none."""
    shifted = blended - blended.min()
    # The clip to [0, 1] of the released code changes nothing that a threshold in [0, 1) sees.
    normalised = shifted / (shifted.max() + 1e-9)
    if constants.stretch:
        normalised = 2 * normalised - 1
    vote = majority_vote if constants.vote_edge == "clipped" else pool_vote
    return vote(normalised > constants.threshold, constants.vote)


def check_relevancy(who: str, relevancy: Float[Tensor, " levels *p"], category: str) -> None:
    """Refuse what cannot be scored, so that no NaN becomes a score.

    Raises:
        ValueError: If there is no level, or a value is not finite.
    """
    if relevancy.shape[0] == 0:
        raise ValueError(
            f"{who}: relevancy of {category!r} must be there at one level or more, got none"
        )
    if not relevancy.isfinite().all():
        raise ValueError(f"{who}: relevancy of {category!r} must be finite, got NaN or inf")
