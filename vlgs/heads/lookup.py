"""GOI's head: a rendered code is classified, and its class is a row of a table of embeddings (Qu et al., ACM MM 2024)."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from vlgs.demands import Demand
from vlgs.heads.clusters import clusters
from vlgs.heads.codebook import require_width
from vlgs.heads.folded import Folded, fold_rows
from vlgs.heads.rows import linear_rows
from vlgs.values import require_range


class LookupTable(nn.Module):
    """One linear map from a code to a score per row of a table; the embedding is the row of the highest score, at unit length.

    Table and map are trained along with the Gaussians, at rates of their own, by `vlgs.objectives.LookupLanguage`. The table
    starts as clusters of the scene's embeddings.

    Args:
        dim: Width d of the codes.
        rows: Of the table.
        width: Embedding width e; 512 for CLIP ViT-B/16.
        map_rate: Adam's, for the map.
        table_rate: Adam's, for the table.
        seed: Of the clusters.

    Raises:
        ValueError: If a width is not positive, or a rate is not in [0, 1].

    Example:
        >>> head = LookupTable(dim=2, rows=4, width=8)
        >>> head.fit(torch.eye(8), torch.ones(8))
        >>> head.predict(torch.zeros(5, 2)).shape, head.decode(torch.zeros(5, 2)).shape
        (torch.Size([5, 4]), torch.Size([5, 8]))
    """

    demands: ClassVar[Sequence[Demand]] = (
        Demand("head=lookup", "loss", "trains_table", "as its scores of rows are no embeddings"),
    )
    has_table: ClassVar[bool] = True
    """What its loss asks of it (`vlgs.demands`)."""

    def __init__(
        self,
        dim: int = 10,
        rows: int = 300,
        width: int = 512,
        map_rate: float = 3e-3,
        table_rate: float = 1e-3,
        seed: int = 0,
    ) -> None:
        super().__init__()
        require_range("lookup head", 1, 65536, dim=dim, rows=rows, width=width)
        require_range("lookup head", 0, 1, map_rate=map_rate, table_rate=table_rate)
        require_range("lookup head", 0, 2**63 - 1, seed=seed)
        self.dim = dim
        self.seed = seed
        self.learning_rate: Mapping[str, float] = {"map": map_rate, "table": table_rate}
        self.map = nn.Linear(dim, rows)
        nn.init.xavier_uniform_(self.map.weight)
        self.table = nn.Parameter(torch.zeros(rows, width))

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """Start the table as clusters of the embeddings; every mask counts the same.

        Raises:
            ValueError: If they have another width than was announced.
        """
        self.require(vectors)
        with torch.no_grad():
            self.table.copy_(clusters(vectors, len(self.table), self.seed))

    def require(self, vectors: Float[Tensor, "m e"]) -> None:
        """See `vlgs.heads.Particular`."""
        require_width("lookup head", vectors, self.table.shape[1])

    def targets(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m e"]:
        """The embeddings as they are."""
        return vectors

    def predict(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b rows"]:
        """A score for each row, before the softmax."""
        return linear_rows(codes, self.map.weight, self.map.bias)

    def decode(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """See `Head`; one row of the table, never a mixture of several."""
        return normalize(self.table, dim=-1, eps=1e-6)[self.predict(codes).argmax(dim=-1)]

    def fold(self) -> Folded:
        """See `vlgs.heads.folded.Foldable`."""
        return fold_rows(self.table, lambda codes: self.predict(codes).argmax(dim=-1))
