"""Words together with the vectors that a query needs for them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.queries.text import TextEncoder

if TYPE_CHECKING:
    from vlgs.queries import Query


@dataclass(frozen=True)
class Prompts:
    """What is asked for, encoded."""

    names: tuple[str, ...]
    text: Float[Tensor, "k e"]
    """Row i belongs to names[i]."""
    negatives: Float[Tensor, "m e"]
    """Vectors of `Query.negatives`; m = 0 when there are none."""


def encode_prompts(query: "Query", encoder: TextEncoder, names: Sequence[str]) -> Prompts:
    """Encode prompts and the negatives of a query; call it before training, so that a missing word costs no run.

    Raises:
        ValueError: If there are no names, or the encoder lacks a word. Where only the negatives are missing, the error points
            to the query that needs none.
    """
    if not names:
        raise ValueError("query: prompts must be at least one word, got none")
    text = encoder.encode(names)
    if not query.negatives:
        return Prompts(tuple(names), text, torch.empty(0, text.shape[1], dtype=text.dtype))
    try:
        negatives = encoder.encode(query.negatives)
    except ValueError as error:
        raise ValueError(
            f"query: the text encoder must know the negatives {', '.join(query.negatives)}, got: {error}; "
            "query=vocab_softmax needs no negatives"
        ) from error
    return Prompts(tuple(names), text, negatives)
