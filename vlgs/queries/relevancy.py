"""The two published ways from cosines to relevancy. Each is a frozen dataclass that satisfies `vlgs.queries.Query`."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields.similarity import cosines

CANONICAL_NEGATIVES = ("object", "things", "stuff", "texture")
"""LERF's words for anything at all (Kerr et al., ICCV 2023)."""


@dataclass(frozen=True)
class LerfRelevancy:
    """Relevancy of LERF and LangSplat: a two-way softmax against each negative, then the minimum.

    ``min_n exp(T cos+) / (exp(T cos+) + exp(T cos_n))`` equals ``sigmoid(T (cos+ - max_n cos_n))``, which is what is computed: it
    cannot overflow. 0.5 is a tie with the strongest negative.

    Args:
        temperature: T, multiplies the cosines.
        negatives: Words every prompt is compared with.

    Raises:
        ValueError: If the temperature is not positive or there are no negatives.
    """

    temperature: float = 10.0
    negatives: Sequence[str] = CANONICAL_NEGATIVES

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "negatives", tuple(self.negatives)
        )  # a list, when it comes from YAML
        _check_temperature("lerf_relevancy", self.temperature)
        if not self.negatives:
            raise ValueError("lerf_relevancy: negatives must be at least one word, got none")

    @property
    def needs_all_prompts(self) -> bool:
        """False: a prompt is compared with the negatives only."""
        return False

    def relevancy(
        self, prompts: Float[Tensor, " k *p"], negatives: Float[Tensor, " m *p"]
    ) -> Float[Tensor, " k *p"]:
        """Relevancy of each prompt from its cosines and those of the negatives, in (0, 1)."""
        return torch.sigmoid(self.temperature * (prompts - negatives.amax(dim=0)))

    def __call__(
        self,
        features: Float[Tensor, "*p e"],
        text: Float[Tensor, "k e"],
        negatives: Float[Tensor, "m e"],
    ) -> Float[Tensor, " k *p"]:
        """Relevancy of each prompt for each feature, in (0, 1); 0.5 where the feature is zero."""
        return self.relevancy(cosines(features, text), cosines(features, negatives))


@dataclass(frozen=True)
class VocabSoftmax:
    """The paper's Eq. 4: a softmax over the whole vocabulary, here all prompts.

    With CLIP's cosines and T = 1 every value lies close to 1/k: only the order of pixels and of classes carries meaning, which
    is all that the min-max step of LERF-OVS and the argmax of the dense protocol look at.

    Args:
        temperature: Multiplies the cosines; 1 is the paper's.
        negatives: Further words that join the denominator; none by default.

    Raises:
        ValueError: If the temperature is not positive.
    """

    temperature: float = 1.0
    negatives: Sequence[str] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "negatives", tuple(self.negatives))
        _check_temperature("vocab_softmax", self.temperature)

    @property
    def needs_all_prompts(self) -> bool:
        """True: the vocabulary is the list of prompts."""
        return True

    def relevancy(
        self, prompts: Float[Tensor, " k *p"], negatives: Float[Tensor, " m *p"]
    ) -> Float[Tensor, " k *p"]:
        """Probability of each prompt from its cosines, in (0, 1); over prompts and negatives they add up to 1."""
        logits = self.temperature * torch.cat([prompts, negatives])
        return logits.softmax(dim=0)[: prompts.shape[0]]

    def __call__(
        self,
        features: Float[Tensor, "*p e"],
        text: Float[Tensor, "k e"],
        negatives: Float[Tensor, "m e"],
    ) -> Float[Tensor, " k *p"]:
        """Probability of each prompt for each feature; uniform where the feature is zero."""
        return self.relevancy(cosines(features, text), cosines(features, negatives))


def _check_temperature(who: str, temperature: float) -> None:
    if not 0 < temperature <= 1e6:  # farther out the sums leave float32
        raise ValueError(f"{who}: temperature must be above 0 and at most 1e6, got {temperature}")
