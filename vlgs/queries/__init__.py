"""Open-vocabulary queries: decoded language features and words in, relevancy maps out."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from vlgs.fields import Field
from vlgs.queries.hyperplane import Hyperplane
from vlgs.queries.objects import Objects
from vlgs.queries.prompts import Prompts, encode_prompts
from vlgs.queries.relevancy import LerfRelevancy, VocabSoftmax
from vlgs.queries.text import TextEncoder
from vlgs.queries.words import Questions, encode_questions, words_of
from vlgs.types import Scene

__all__ = [
    "Hyperplane",
    "Learning",
    "LerfRelevancy",
    "Objects",
    "Particular",
    "Prompts",
    "Query",
    "Questions",
    "TextEncoder",
    "VocabSoftmax",
    "encode_prompts",
    "encode_questions",
    "words_of",
]


@runtime_checkable
class Query(Protocol):
    """The interface of a query: turns the cosines between a pixel and words into the relevancy of each prompt.

    A query is a function of cosines alone, so that decoding and the one large matrix product are shared by all queries and by
    the class map of the same view (`vlgs.fields.similarity`).
    """

    @property
    def negatives(self) -> Sequence[str]:
        """Words that every prompt is compared with; may be empty."""
        ...

    @property
    def needs_all_prompts(self) -> bool:
        """Whether prompts compete with each other, so that a prompt cannot be scored alone."""
        ...

    def relevancy(
        self, prompts: Float[Tensor, " k *p"], negatives: Float[Tensor, " m *p"]
    ) -> Float[Tensor, " k *p"]:
        """Relevancy of k prompts from cosines, each in [0, 1]."""
        ...

    def __call__(
        self,
        features: Float[Tensor, "*p e"],
        text: Float[Tensor, "k e"],
        negatives: Float[Tensor, "m e"],
    ) -> Float[Tensor, " k *p"]:
        """Relevancy of k prompts for features of any length."""
        ...


@runtime_checkable
class Learning(Protocol):
    """What a query also is that learns from the training views of a scene what its words mean there."""

    def learn(self, field: Field, scene: Scene, prompts: Prompts) -> Field:
        """The same field, which answers these words as they were learned."""
        ...


@runtime_checkable
class Particular(Protocol):
    """What a query also is that not every scene will do for."""

    def require(self, scene: Scene, words: Sequence[str]) -> None:
        """Refuse a scene whose words it could not answer, before anything is trained.

        Raises:
            ValueError: If the scene lacks something, or what was given for it.
        """
        ...
