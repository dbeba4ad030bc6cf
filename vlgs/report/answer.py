"""Renders one view of a trained scene and answers prompts in it. Scores and pictures are both made from this."""

from collections.abc import Collection
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields import Field, FieldImages
from vlgs.queries import Prompts
from vlgs.types import Camera, View

KEPT_BYTES = 64 * 2**20
"""Of all answers that are kept for pictures: twenty views of 200x150 pixels with twenty words."""


@dataclass(frozen=True)
class Answer:
    """A rendered view and how its pixels compare with the prompts."""

    color: Float[Tensor, "h w 3"]
    """Clamped to [0, 1]."""
    feature: Float[Tensor, "levels h w d"] | None
    """See `vlgs.fields.FieldImages`; None where the field does not render it."""
    cosines: Float[Tensor, "levels k h w"] | None
    """With every prompt (`vlgs.fields.Field.similarity`); None without prompts."""
    negatives: Float[Tensor, "levels m h w"] | None
    """With every negative of the query."""


class KeptAnswers:
    """Answers of views that are asked twice, for scores and for pictures; decoding the pixels again would take longer than to draw them.

    Args:
        views: Whose answers are kept.
        most: Bytes of them in all; a view that would be more is answered each time.
    """

    def __init__(self, views: Collection[View] = (), most: int = KEPT_BYTES) -> None:
        self.cameras = [view.camera for view in views]
        self.left = most
        self.kept: list[tuple[Field, Camera, Prompts | None, Answer]] = []

    def answer(self, field: Field, camera: Camera, prompts: Prompts | None) -> Answer:
        """`answer_view`, or what it gave when the same was asked."""
        for of, seen_by, asked, answer in self.kept:
            if of is field and seen_by is camera and _same(asked, prompts):
                return answer
        answer = answer_view(field, camera, prompts)
        values = (getattr(answer, part.name) for part in fields(answer))
        size = sum(value.nbytes for value in values if value is not None)
        if size <= self.left and any(camera is one for one in self.cameras):
            self.left -= size
            self.kept.append((field, camera, prompts, answer))
        return answer


def _same(asked: Prompts | None, prompts: Prompts | None) -> bool:
    if asked is None or prompts is None:
        return asked is prompts
    same = asked.names == prompts.names and torch.equal(asked.text, prompts.text)
    return same and torch.equal(asked.negatives, prompts.negatives)


@torch.no_grad()
def answer_view(
    field: Field, camera: Camera, prompts: Prompts | None, seen: FieldImages | None = None
) -> Answer:
    """Render a view once and ask it once, for all prompts and negatives together.

    Args:
        field: The trained scene.
        camera: Where to look from.
        prompts: What is asked for, or None for the pictures alone.
        seen: What the field rendered for this camera, with colour at least; None: it is rendered.
    """
    if seen is None:
        seen = field.render(camera, frozenset({"color"}) | (field.outputs & {"feature"}))
    assert seen.color is not None  # it was asked for
    cosines = negatives = None
    if prompts is not None:
        words = torch.cat([prompts.text, prompts.negatives])
        both = field.similarity(camera, words, seen)
        cosines, negatives = both.split([len(prompts.text), len(prompts.negatives)], dim=1)
    return Answer(seen.color.clamp(0, 1), seen.feature, cosines, negatives)
