"""Clusters of embeddings, with which codebooks start."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.heads.threads import one_thread

ROUNDS = 10
"""Assignments and new centres; GOI's number."""


@torch.no_grad()
def clusters(
    vectors: Float[Tensor, "m e"], count: int, seed: int = 0, rounds: int = ROUNDS
) -> Float[Tensor, "count e"]:
    """Unit centres of so many clusters of embeddings: k-means by cosine, which starts as k-means++ does.

    A first centre is drawn, each further one in proportion to how far an embedding is from the nearest centre so far. Then, in
    turns, every embedding goes to the nearest centre, and a centre becomes the direction of the sum of what it has. One that nothing
    goes to stays. With fewer different embeddings than centres all of them are centres, and some are so twice.

    Args:
        vectors: At least one, of any length but zero. All count the same.
        count: How many centres.
        seed: Of the draws; the same seed gives the same bits.
        rounds: How often centres move.

    Raises:
        ValueError: If there is no vector, or one is not finite.
    """
    if len(vectors) == 0 or not vectors.isfinite().all():
        raise ValueError(
            f"clusters: vectors must be finite and at least 1, got {len(vectors)}"
            f"{' that are not all finite' if len(vectors) else ''}"
        )
    generator = torch.Generator().manual_seed(seed)
    with one_thread():
        unit = normalize(vectors.detach().float(), dim=-1)
        centers = _first(unit, count, generator)
        for _ in range(rounds):
            nearest = (unit @ centers.T).argmax(dim=1)
            sums = torch.zeros_like(centers).index_add_(0, nearest, unit)
            taken = torch.bincount(nearest, minlength=count) > 0
            centers = torch.where(taken[:, None], normalize(sums, dim=-1), centers)
    return centers


def _first(
    unit: Float[Tensor, "m e"], count: int, generator: torch.Generator
) -> Float[Tensor, "count e"]:
    """Rows that are far from each other, drawn one after the other."""
    rows = [int(torch.randint(len(unit), (1,), generator=generator))]
    away = 1 - unit @ unit[rows[0]]
    for _ in range(count - 1):
        # Of embeddings that are centres already nothing is left but rounding; where all are, any may come again.
        weight = torch.where(away > 1e-6, away, 0.0)
        weight = weight if weight.any() else torch.ones_like(weight)
        rows.append(int(torch.multinomial(weight, 1, generator=generator)))
        away = torch.minimum(away, 1 - unit @ unit[rows[-1]])
    return unit[rows]
