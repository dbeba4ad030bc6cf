"""Gaussian Grouping's head: which object a code is of, and with it that object's mean embedding (Ye et al., ECCV 2024)."""

import math
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from vlgs.heads.folded import Folded, fold_linear, fold_rows
from vlgs.heads.rows import linear_rows
from vlgs.values import require_choice, require_range


class Classifier(nn.Module):
    """A linear map from a rendered code to the probabilities of the scene's masks and of "nothing", trained along with the Gaussians.

    Each row of `vlgs.types.Scene.mask_vectors` is a class, which is meant for masks that all views agree on
    (`vlgs.training.associate.Associate`). The last class is nothing, whose embedding is zero.

    Args:
        dim: Width d of the codes; 16 is Gaussian Grouping's.
        learning_rate: Adam's, for the map; 5e-4 is Gaussian Grouping's.
        answer: What a pixel shows. ``probabilities``: the mean embedding of all objects by their probability, so that what is surest of an object has
            the best fit among all its pixels. ``most_probable``: the embedding of one object, of which all pixels fit a word equally well.

    Raises:
        ValueError: If the width is not positive, the learning rate not in [0, 1], or there is no such answer.
    """

    classifies: ClassVar[bool] = True
    """It knows the probability of each mask."""
    vectors: Tensor

    def __init__(
        self,
        dim: int = 16,
        learning_rate: float = 5e-4,
        answer: Literal["probabilities", "most_probable"] = "probabilities",
    ) -> None:
        super().__init__()
        require_range("classifier", 1, 65536, dim=dim)
        require_range("classifier", 0, 1, learning_rate=learning_rate)
        require_choice("classifier", "answer", answer, ("probabilities", "most_probable"))
        self.dim = dim
        self.learning_rate: float | None = learning_rate
        self.answer = answer
        self.map = nn.Linear(dim, 1)
        self.register_buffer("vectors", torch.zeros(0, 0))
        self.register_load_state_dict_pre_hook(_build_for_state)

    @property
    def classes(self) -> int:
        """How many there are, nothing included."""
        return self.map.out_features

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """Have a class for every mask; see `vlgs.heads.Head`."""
        self.build(*vectors.shape)
        self.vectors[:-1] = vectors.detach()
        bound, generator = 1 / math.sqrt(self.dim), torch.Generator().manual_seed(0)
        for parameter in self.map.parameters():  # as torch starts a convolution
            nn.init.uniform_(parameter, -bound, bound, generator=generator)

    def build(self, masks: int, width: int) -> None:
        """Lay out the map for so many masks and embeddings of this width."""
        self.map = nn.Linear(self.dim, masks + 1)
        self.vectors = torch.zeros(masks + 1, width)

    def logits(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b classes"]:
        """Of every mask, and of nothing as the last."""
        return linear_rows(codes, self.map.weight, self.map.bias)

    def targets(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m e"]:
        """The embeddings as they are."""
        return vectors

    def predict(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """Embeddings, the shorter the more a code shows nothing."""
        logits = self.logits(codes)
        if self.answer == "most_probable":
            return self.vectors[logits.argmax(dim=-1)]
        return logits.softmax(dim=-1) @ self.vectors

    def decode(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """See `vlgs.heads.Head`; `predict` at unit length."""
        return normalize(self.predict(codes), dim=-1, eps=1e-6)

    def fold(self) -> Folded:
        """See `vlgs.heads.folded.Foldable`."""
        if self.answer == "most_probable":
            return fold_rows(self.vectors, lambda codes: self.logits(codes).argmax(dim=-1))
        return fold_linear(self.vectors.T, None, lambda codes: self.logits(codes).softmax(dim=-1))


def _build_for_state(module: Classifier, state: dict[str, Any], prefix: str, *_: Any) -> None:
    vectors = state.get(f"{prefix}vectors")
    if isinstance(vectors, Tensor) and vectors.dim() == 2 and vectors.shape != module.vectors.shape:
        module.build(len(vectors) - 1, vectors.shape[1])
