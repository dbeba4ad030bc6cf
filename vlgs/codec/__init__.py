"""Codecs: an image-text embedding, and the short code of it that a Gaussian carries."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Codec(Protocol):
    """The interface of a codec. Implementations are modules, so that checkpoints contain what they learned."""

    dim: int
    """Width d of the codes."""

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """Learn the codes of one scene.

        Args:
            vectors: Unit embeddings of the masks, `Scene.mask_vectors`.
            areas: Pixels that each one covers, `Scene.mask_areas`; its weight.
        """
        ...

    def encode(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m d"]:
        """Codes of unit embeddings."""
        ...

    def decode(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """Unit embeddings of codes, which may be blends of several."""
        ...
