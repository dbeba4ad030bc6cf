"""What the points of space mean: hash grids of their own, and networks that turn their features into embeddings."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from vlgs.fields.hash_grid import GridConfig, HashGrid
from vlgs.fields.radiance import mlp
from vlgs.heads.rows import layers
from vlgs.values import require_fields, require_range


def _lerf_grids() -> tuple[GridConfig, GridConfig]:
    return GridConfig(12, 8, 16, 128, 15), GridConfig(12, 8, 128, 512, 15)


@dataclass(frozen=True)
class LanguageConfig:
    """Networks of LERF, OpenNeRF and FMGS, which differ in these numbers.

    Raises:
        ValueError: If a number is out of range.
    """

    grids: Sequence[GridConfig] = field(default_factory=_lerf_grids)
    hidden: int = 4
    """Hidden layers before the embedding."""
    width: int = 256
    """Of each of them."""
    scaled: bool = True
    """Whether an embedding is asked for at a physical scale (LERF)."""
    half: bool = True
    """Networks in half precision, as the released programs have them; bfloat16 here."""

    def __post_init__(self) -> None:
        require_fields("language field", self)
        object.__setattr__(self, "grids", tuple(self.grids))  # a list, when it comes from YAML
        require_range("language field", 0, 16, hidden=self.hidden)
        require_range("language field", 1, 4096, width=self.width)
        if not self.grids:
            raise ValueError("language field: grids must be at least one, got none")


class LanguageField(nn.Module):
    """Features of places in the unit cube, and what they say: an embedding, and a second, low-level map.

    Args:
        config: Its grids and networks.
        embedding: Width of the embeddings.
        second: Width of the second map; 0: none.
        generator: Draws the weights of the start.
    """

    def __init__(
        self,
        config: LanguageConfig,
        embedding: int,
        second: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.grids = nn.ModuleList([HashGrid(grid, generator) for grid in config.grids])
        width = sum(grid.width for grid in config.grids)
        hidden = [config.width] * config.hidden
        self.head = mlp([width + config.scaled, *hidden, embedding], generator)
        self.second = mlp([width, config.width, second], generator) if second else None

    def features(self, places: Float[Tensor, "n 3"]) -> Float[Tensor, "n w"]:
        """Of places in the unit cube, from all grids."""
        return torch.cat([grid(places) for grid in self.grids], dim=-1)

    def embed(
        self, features: Float[Tensor, "n w"], scale: Float[Tensor, " n"] | float | None = None
    ) -> Float[Tensor, "n e"]:
        """Unit embeddings of features, at a physical scale if there is one for it."""
        if self.config.scaled:
            assert scale is not None
            size = torch.as_tensor(scale, dtype=features.dtype).expand(len(features))
            features = torch.cat([features, size[:, None]], dim=-1)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.half):
            raw = layers(self.head, features)
        return normalize(raw.to(features.dtype), dim=-1, eps=1e-6)

    def low(self, features: Float[Tensor, "n w"]) -> Float[Tensor, "n c"]:
        """The second map of features."""
        assert self.second is not None
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.half):
            raw = layers(self.second, features)
        return raw.to(features.dtype)
