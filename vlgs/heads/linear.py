"""Feature-3DGS's head: one linear map, trained along with the Gaussians (Zhou et al., CVPR 2024)."""

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from vlgs.heads.folded import Folded, fold_linear
from vlgs.heads.rows import linear_rows
from vlgs.values import require_range


class Linear(nn.Module):
    """A rendered code becomes an embedding by a linear map, and the target is the embedding itself.

    This is the 1x1 convolution of Feature-3DGS, which it calls the speed-up module. Nothing is known of the codes before
    training, so that they cannot be lifted from masks. Targets are as wide as the embedding: a map of 512 numbers per pixel.

    Args:
        dim: Width d of the codes; 128 is Feature-3DGS's.
        width: Embedding width e; 512 for CLIP ViT-B/16.
        learning_rate: Adam's, for weights and biases; 1e-4 is Feature-3DGS's.

    Raises:
        ValueError: If a width is not positive, or the learning rate is not in [0, 1].

    Example:
        >>> import torch
        >>> head = Linear(dim=8, width=16)
        >>> head.predict(torch.zeros(5, 8)).shape
        torch.Size([5, 16])
    """

    def __init__(self, dim: int = 128, width: int = 512, learning_rate: float = 1e-4) -> None:
        super().__init__()
        require_range("linear head", 1, 65536, dim=dim, width=width)
        require_range("linear head", 0, 1, learning_rate=learning_rate)
        self.dim = dim
        self.learning_rate: float | None = learning_rate
        self.map = nn.Linear(dim, width)

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """Check that the embeddings have the width that was announced.

        Raises:
            ValueError: If they have another one.
        """
        self.require(vectors)

    def require(self, vectors: Float[Tensor, "m e"]) -> None:
        """See `vlgs.heads.Particular`."""
        if vectors.shape[1] != self.map.out_features:
            raise ValueError(
                f"linear head: width must be the embedding width {vectors.shape[1]}, got {self.map.out_features}"
            )

    def targets(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m e"]:
        """The embeddings as they are."""
        return vectors

    def predict(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """Embeddings of any length."""
        return linear_rows(codes, self.map.weight, self.map.bias)

    def decode(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """See `Head`; `predict` at unit length."""
        return normalize(self.predict(codes), dim=-1, eps=1e-6)

    def fold(self) -> Folded:
        """See `vlgs.heads.folded.Foldable`."""
        return fold_linear(self.map.weight, self.map.bias, lambda codes: codes)
