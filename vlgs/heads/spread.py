"""Where the codes of a scene go before they are learnt: apart, all the more where what they stand for differs."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.heads.clusters import clusters

REACH = 0.35
"""Of the repulsion, as a standard deviation: a distance between unit codes, about twice the noise that rendered codes have."""
STARTS = 16
"""Random places to begin with, of whose outcomes the best stays: with many the seed hardly matters."""
STEPS = 300
FIRST_REACH = 3.0
"""Times `REACH` at the first step: far neighbours are sorted out before near ones."""
RATE = 0.1


def spread_codes(
    vectors: Float[Tensor, "m e"], count: int, dim: int, seed: int
) -> Float[Tensor, "m d"]:
    """Unit codes, one for every embedding: that of its cluster, and the codes of clusters repel each other on the sphere.

    The energy of two clusters is `exp(-d^2 / 2 REACH^2)` of the distance d of their codes, times how much they differ (one minus the cosine from the mean of
    all, at most 1) and the roots of how many embeddings both have. Its minimum is sought by Adam.

    Args:
        vectors: Unit embeddings, at least one.
        count: Clusters.
        dim: Code width.
        seed: Of clusters and starts.
    """
    centers = clusters(vectors, count, seed)
    nearest = (vectors @ centers.T).argmax(dim=1)
    sizes = torch.bincount(nearest, minlength=count).float().sqrt()
    apart = normalize(centers - vectors.mean(dim=0), dim=-1)
    differ = (1 - apart @ apart.T).clamp(0, 1)
    weights = differ * torch.outer(sizes, sizes) / sizes.sum().square()
    return _repelled(weights, dim, torch.Generator().manual_seed(seed))[nearest]


def _repelled(
    weights: Float[Tensor, "k k"], dim: int, generator: torch.Generator
) -> Float[Tensor, "k d"]:
    places = torch.randn(STARTS, len(weights), dim, generator=generator).requires_grad_()
    optimizer = torch.optim.Adam([places], lr=RATE)
    for step in range(STEPS):
        left = max(0.0, 1 - 1.5 * step / STEPS)  # the last third at `REACH`
        reach = REACH * (1 + (FIRST_REACH - 1) * left)
        optimizer.zero_grad()
        _energy(places, weights, reach).sum().backward()
        optimizer.step()
    with torch.no_grad():
        best = _energy(places, weights, REACH).argmin()
        return normalize(places[best], dim=-1)


def _energy(
    places: Float[Tensor, "s k d"], weights: Float[Tensor, "k k"], reach: float
) -> Float[Tensor, " s"]:
    codes = normalize(places, dim=-1)
    squared = 2 - 2 * codes @ codes.mT
    return (weights * torch.exp(-squared / (2 * reach**2))).sum(dim=(1, 2))
