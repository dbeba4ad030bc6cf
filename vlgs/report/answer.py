"""Renders one view of a trained scene and answers prompts in it. Scores and pictures are both made from this."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields import Field, FieldImages
from vlgs.query import Prompts
from vlgs.types import Camera


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
