"""Codes are embeddings in the directions that the masks of a scene spread in, so that blending codes is blending embeddings."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear, normalize

from vlgs.heads.clusters import clusters
from vlgs.heads.folded import Folded
from vlgs.heads.threads import one_thread
from vlgs.values import require_range

EMPTY = 1e-9
"""Of the largest eigenvalue: a direction below it has nothing of any mask and is left out."""


class Principal(nn.Module):
    """The first principal directions of a scene's mask embeddings, not centred, and what its masks show most often; fitted in closed form.

    Unlike an autoencoder the map is linear with orthonormal rows: means over views and blends along a ray are the same in codes as in embeddings,
    and a code of length zero is no embedding. An answer is drawn to the nearest of some clusters of the masks' embeddings, which are means over
    many views: noise of single masks is gone from it, and the edge between two things belongs to one of them. Its length is 1 where that
    of the blended code is `sure` or more, and falls with it: what few views agree on, or hardly anything covers, answers weakly to every word.

    Args:
        dim: Code width d, at most the embedding width.
        entries: Clusters; 0: answers are drawn to none.
        sharpness: How strongly an answer is drawn: weights of clusters are a softmax over so many times their cosines.
        sure: Length of a code from which its answer is as long as an answer can be.
        area_power: Exponent of a mask's pixels in its weight for the directions; 0: every mask counts the same.
        seed: Of the clusters' start.

    Raises:
        ValueError: If a number is out of its range.
    """

    untrained: ClassVar[bool] = True
    """It is fitted before the Gaussians are trained."""
    lengths_count: ClassVar[bool] = True
    """See `vlgs.heads.lengths_count`."""
    learning_rate: float | None = None
    basis: Tensor
    """[d, e], orthonormal rows; the last are zero where the masks spread in fewer directions."""
    centers: Tensor
    """[k, d], of the clusters, at unit length."""

    def __init__(
        self,
        dim: int = 32,
        entries: int = 64,
        sharpness: float = 100.0,
        sure: float = 0.5,
        area_power: float = 0.25,
        seed: int = 0,
    ) -> None:
        super().__init__()
        require_range("principal head", 1, 4096, dim=dim)
        require_range("principal head", 0, 65536, entries=entries)
        require_range("principal head", 1e-3, 1e6, sharpness=sharpness)
        require_range("principal head", 1e-6, 1, sure=sure)
        require_range("principal head", 0, 1, area_power=area_power)
        require_range("principal head", 0, 2**63 - 1, seed=seed)
        self.dim, self.entries, self.seed = dim, entries, seed
        self.sharpness, self.sure, self.area_power = sharpness, sure, area_power
        self.register_buffer("basis", torch.zeros(dim, 0))
        self.register_buffer("centers", torch.zeros(0, dim))
        self.register_load_state_dict_pre_hook(_size_for_state)

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """See `vlgs.heads.Head`.

        Raises:
            ValueError: If there is no embedding, one is not finite, or they are narrower than the codes.
        """
        if not len(vectors) or not vectors.isfinite().all():
            raise ValueError(
                f"principal head: vectors must be finite and at least 1, got {len(vectors)}"
            )
        self.require(vectors)
        with one_thread():
            rows = vectors.detach().double()
            rows = rows * areas.double().clamp_min(1)[:, None] ** (self.area_power / 2)
            spread, directions = torch.linalg.eigh(rows.T @ rows)  # ascending
            basis = directions.T.flip(0)[: self.dim]
            spread = spread.flip(0)[: self.dim]
            largest = basis.gather(1, basis.abs().argmax(1, keepdim=True))
            basis = basis * largest.sign() * (spread > EMPTY * spread[0])[:, None]
            self.basis = basis.to(vectors.dtype).contiguous()
            if self.entries:
                self.centers = clusters(self.targets(vectors), self.entries, self.seed)

    def require(self, vectors: Float[Tensor, "m e"]) -> None:
        """See `vlgs.heads.Particular`."""
        if vectors.shape[1] < self.dim:
            raise ValueError(
                f"principal head: dim must be at most the embedding width {vectors.shape[1]}, got {self.dim}"
            )

    def targets(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m d"]:
        """Coordinates; shorter than 1 by what the directions leave out."""
        return linear(vectors, self._fitted().to(vectors.dtype))

    def predict(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
        """The codes as they are: one is compared with another."""
        return codes

    def decode(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """See `Head`; shorter than 1 where it is not sure."""
        return self._drawn(codes) @ self._fitted().to(codes.dtype)

    def fold(self) -> Folded:
        """See `vlgs.heads.folded.Foldable`."""
        return Folded(self._fitted().T, self._drawn, lengths_count=True)

    def _drawn(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
        """Towards the clusters, as long as sure."""
        length = torch.linalg.vector_norm(codes, dim=-1, keepdim=True)
        drawn = codes / length.clamp_min(EMPTY)
        if len(self.centers):
            centers = self.centers.to(codes.dtype)
            weights = (self.sharpness * linear(drawn, centers)).softmax(-1)
            drawn = normalize(weights @ centers, dim=-1)
        return drawn * (length / self.sure).clamp_max(1)

    def _fitted(self) -> Float[Tensor, "d e"]:
        if not self.basis.shape[1]:
            raise ValueError(
                "principal head: fit or a state dict must come before encoding, got neither"
            )
        return self.basis


def _size_for_state(module: nn.Module, state: Mapping[str, Any], prefix: str, *_: object) -> None:
    """Before a state dict is loaded: take the widths that it was fitted to."""
    assert isinstance(module, Principal)
    for name, width in (("basis", 0), ("centers", 1)):
        saved = state.get(prefix + name)
        if isinstance(saved, Tensor) and saved.dim() == 2 and saved.shape[width] == module.dim:
            setattr(module, name, torch.zeros_like(saved))
