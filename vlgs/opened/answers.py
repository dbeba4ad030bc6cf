"""What a view, or the Gaussians themselves, answer to words."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.fields import NO_GAUSSIANS, Field, FieldImages, HasGaussians, gaussians_of
from vlgs.metrics.segment import blend, smooth
from vlgs.queries import Query, Questions
from vlgs.report.answer import answer_view
from vlgs.report.pictures import spread
from vlgs.types import Camera

LEAST = 1 / 255
"""Weight under which a Gaussian is not drawn."""
SHARE = 0.7
"""Of a word's range of relevancy, above which a pixel answers: the top 30 % are LERF-OVS's, of one view."""
_LOOKED_AT = 8
"""Photographs' cameras from which a range is found."""


@dataclass(frozen=True)
class Answers:
    """One view, asked for words."""

    words: Sequence[str]
    color: Float[Tensor, "h w 3"]
    relevancy: Float[Tensor, "levels k h w"]
    """In [0, 1], half of it a mean over 30 pixels, as LERF-OVS segments it (`vlgs.metrics.segment`)."""
    scores: Float[Tensor, "levels k"]
    """Largest relevancy of each word; that of the whole view decides which level answers."""

    def level(self, word: int, chosen: int | None = None) -> int:
        """Place of the mask level that answers a word: the chosen one, or the one with the best score."""
        return int(self.scores[:, word].argmax()) if chosen is None else chosen

    def score(self, word: int, chosen: int | None = None) -> float:
        """How well the view answers a word."""
        return float(self.scores[self.level(word, chosen), word])


def tie(query: Query, count: int) -> float:
    """Relevancy at which a word is no better than what it is compared with.

    Args:
        query: How relevancy is computed.
        count: Words that are asked.
    """
    return 1 / max(count, 2) if query.needs_all_prompts else 0.5


@torch.no_grad()
def ask_view(
    field: Field, camera: Camera, asked: Questions, seen: FieldImages | None = None
) -> Answers:
    """Look from a camera, and ask for all words at once.

    Args:
        field: The trained scene.
        camera: Where to look from.
        asked: The words.
        seen: What the field rendered for this camera, with colour; None: it is rendered.
    """
    answer = answer_view(field, camera, asked.prompts, seen)
    assert answer.cosines is not None  # there are prompts
    assert answer.negatives is not None
    both = zip(answer.cosines, answer.negatives, strict=True)
    maps = [asked.query.relevancy(cosines, negatives) for cosines, negatives in both]
    relevancy = torch.stack([blend(level, smooth(level)) for level in maps])
    scores = relevancy.flatten(2).amax(dim=2)
    return Answers(asked.prompts.names, answer.color, relevancy, scores)


@dataclass(frozen=True)
class Range:
    """Relevancy of a word over a scene, the same for all views, so that it looks cold where it is not."""

    low: float
    high: float
    tie: float
    """See `tie`."""

    def shares(self, relevancy: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]:
        """From 0 at the lowest to 1 at the highest, as heat maps show it."""
        return ((relevancy - self.low) / max(self.high - self.low, 1e-9)).clamp(0, 1)

    def threshold(self, share: float = SHARE) -> float:
        """Relevancy above which a pixel or a Gaussian answers: so far up in the range, and never below a tie."""
        return max(self.low + share * (self.high - self.low), self.tie)


def ranges(
    field: Field, cameras: Sequence[Camera], asked: Questions, chosen: int | None = None
) -> list[Range]:
    """Of each word, over at most eight of the cameras.

    Args:
        field: The trained scene.
        cameras: Of photographs, at least one; held-out ones are not too many and see all of the scene.
        asked: The words.
        chosen: Place of the mask level; None: the best of each view.
    """
    return ranges_of(
        [ask_view(field, camera, asked) for camera in looked_at(cameras)], asked, chosen
    )


def looked_at(cameras: Sequence[Camera]) -> Sequence[Camera]:
    """Those of a scene's cameras from which a range is found."""
    return spread(cameras, _LOOKED_AT)


def ranges_of(
    answers: Sequence[Answers], asked: Questions, chosen: int | None = None
) -> list[Range]:
    """`ranges` of views that were asked already."""
    least, found = tie(asked.query, len(asked.prompts.names)), []
    for word in range(len(asked.prompts.names)):
        maps = [answer.relevancy[answer.level(word, chosen), word] for answer in answers]
        low, high = min(float(m.min()) for m in maps), max(float(m.max()) for m in maps)
        found.append(Range(low, high, least))
    return found


@torch.no_grad()
def gaussian_relevancy(gaussians: HasGaussians, asked: Questions) -> Float[Tensor, "k n"]:
    """Relevancy of each word for each Gaussian of one mask level, asked for itself."""
    text = torch.cat([asked.prompts.text, asked.prompts.negatives])
    found = gaussians.gaussian_similarity(text)[0]
    own, negatives = found.split([len(asked.prompts.text), len(asked.prompts.negatives)])
    return asked.query.relevancy(own, negatives)


@torch.no_grad()
def select_gaussians(
    field: Field, asked: Questions, word: int, threshold: float, level: int | None = None
) -> tuple[HasGaussians, Bool[Tensor, " n"]]:
    """Gaussians that answer a word: their own code is more relevant than a threshold, and both colour and language draw them (`LEAST`).

    No rendering is involved. What is hidden inside of things answers too, and what answers only as a blend of several does not.

    Args:
        field: The trained scene.
        asked: The words.
        word: Which of them.
        threshold: Of the relevancy; see `Range.threshold`.
        level: Place of the mask level; None: the one whose chosen Gaussians are the most relevant on average.

    Returns:
        The Gaussians of that level, and which of them.

    Raises:
        ValueError: If the field has no Gaussians.
    """
    levels = gaussians_of(field)
    if levels is None:
        raise ValueError(f"select: field must have Gaussians, got one without: {NO_GAUSSIANS}")
    best: tuple[float, HasGaussians, Tensor] | None = None
    for gaussians in levels if level is None else [levels[level]]:
        relevancy = gaussian_relevancy(gaussians, asked)[word]
        weight = gaussians.language_weights()
        seen = torch.minimum(gaussians.opacities(), weight if weight.dim() == 1 else weight.amax(1))
        chosen = (relevancy > threshold) & (seen >= LEAST)
        mean = float(relevancy[chosen].mean()) if chosen.any() else -1.0
        if best is None or mean > best[0]:
            best = mean, gaussians, chosen
    assert best is not None  # a field has a level
    return best[1], best[2]
