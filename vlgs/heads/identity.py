"""The head that changes nothing: Gaussians carry the embeddings themselves."""

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from vlgs.values import require_range


class Identity(nn.Module):
    """Codes are the embeddings (d = e), for lifting and for judging what compression costs.

    Args:
        dim: Embedding width e; 512 for CLIP ViT-B/16.

    Raises:
        ValueError: If `dim` is not positive.
    """

    untrained: ClassVar[bool] = True
    """It is fitted before the Gaussians are trained."""
    learning_rate: float | None = None

    def __init__(self, dim: int = 512) -> None:
        super().__init__()
        require_range("identity head", 1, 65536, dim=dim)
        self.dim = dim

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """Check that the embeddings have the width that was announced.

        Raises:
            ValueError: If they have another one.
        """
        self.require(vectors)

    def require(self, vectors: Float[Tensor, "m e"]) -> None:
        """See `vlgs.heads.Particular`."""
        if vectors.shape[1] != self.dim:
            raise ValueError(
                f"identity head: dim must be the embedding width {vectors.shape[1]}, got {self.dim}"
            )

    def targets(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m e"]:
        """The embeddings as they are."""
        return vectors

    def predict(self, codes: Float[Tensor, "*b e"]) -> Float[Tensor, "*b e"]:
        """The codes as they are."""
        return codes

    def decode(self, codes: Float[Tensor, "*b e"]) -> Float[Tensor, "*b e"]:
        """Unit length again, which blending does not keep."""
        return normalize(codes, dim=-1, eps=1e-6)
