"""LangSplatV2's head: a rendered code says how much of each entry of a codebook a pixel shows (Li et al., NeurIPS 2025)."""

from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from vlgs.heads.clusters import clusters
from vlgs.heads.folded import Folded, fold_linear
from vlgs.heads.rows import linear_rows
from vlgs.values import require_range


class Codebook(nn.Module):
    """An embedding is the sum of the entries of a codebook, weighted by the code; entries are trained along with the Gaussians.

    The entries start as the centres of clusters of the scene's embeddings. With ``gaussians.codes=sparse`` a Gaussian carries weights
    of a few entries, and what is blended stays a mean of entries: unlike codes of an autoencoder, two of them never mix to a third
    thing.

    Args:
        dim: Entries d; 64 is LangSplatV2's.
        width: Embedding width e; 512 for CLIP ViT-B/16.
        learning_rate: Adam's, for the entries.
        seed: Of the clusters.

    Raises:
        ValueError: If a width is not positive, or the learning rate is not in [0, 1].

    Example:
        >>> head = Codebook(dim=4, width=8)
        >>> head.fit(torch.eye(8), torch.ones(8))
        >>> head.predict(torch.tensor([[1.0, 0.0, 0.0, 0.0]])).shape
        torch.Size([1, 8])
    """

    has_entries: ClassVar[bool] = True
    """What its loss asks of it (`vlgs.demands`)."""

    def __init__(
        self, dim: int = 64, width: int = 512, learning_rate: float = 2.5e-3, seed: int = 0
    ) -> None:
        super().__init__()
        require_range("codebook head", 1, 65536, dim=dim, width=width)
        require_range("codebook head", 0, 1, learning_rate=learning_rate)
        require_range("codebook head", 0, 2**63 - 1, seed=seed)
        self.dim = dim
        self.seed = seed
        self.learning_rate: float | None = learning_rate
        self.entries = nn.Parameter(torch.zeros(dim, width))

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """Start the entries as clusters of the embeddings; every mask counts the same.

        Raises:
            ValueError: If they have another width than was announced.
        """
        self.require(vectors)
        with torch.no_grad():
            self.entries.copy_(clusters(vectors, self.dim, self.seed))

    def require(self, vectors: Float[Tensor, "m e"]) -> None:
        """See `vlgs.heads.Particular`."""
        require_width("codebook head", vectors, self.entries.shape[1])

    def targets(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m e"]:
        """The embeddings as they are."""
        return vectors

    def predict(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """Embeddings of any length."""
        return linear_rows(codes, self.entries.T)

    def decode(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """See `Head`; `predict` at unit length."""
        return normalize(self.predict(codes), dim=-1, eps=1e-6)

    def fold(self) -> Folded:
        """See `vlgs.heads.folded.Foldable`."""
        return fold_linear(self.entries.T, None, lambda codes: codes)


def require_width(who: str, vectors: Float[Tensor, "m e"], width: int) -> None:
    """Refuse embeddings of another width than was announced.

    Raises:
        ValueError: Names both.
    """
    if vectors.shape[1] != width:
        raise ValueError(
            f"{who}: width must be the embedding width {vectors.shape[1]}, got {width}"
        )
