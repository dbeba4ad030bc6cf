"""Embeddings as coordinates in the space that they span, so that words are compared with codes and no embedding is made.

The last step of most heads is linear: an embedding is ``W x + b`` of what comes before. With ``[W b] = Q R``, Q of orthonormal columns, it is ``Q y`` with
``y = R [x; 1]``, and a word t has the product ``(Q^T t) y`` with it; ``|y|`` is its length. y has at most as many numbers as x and one more, in place of 512.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import linear


@dataclass(frozen=True)
class Folded:
    """A head whose training is over, without its last step."""

    basis: Float[Tensor, "e r"]
    """Orthonormal columns."""
    coordinates: Callable[[Float[Tensor, "p d"]], Float[Tensor, "p r"]]
    """Of the embeddings of codes, in this basis, before they are brought to unit length."""
    lengths_count: bool = False
    """See `vlgs.heads.lengths_count`."""


@runtime_checkable
class Foldable(Protocol):
    """What a head also is whose embeddings need not be made to be compared with words."""

    def fold(self) -> Folded:
        """Coordinates in the place of embeddings, of the weights as they are now."""
        ...


def fold_linear(
    weight: Float[Tensor, "e i"],
    bias: Float[Tensor, " e"] | None,
    before: Callable[[Float[Tensor, "p d"]], Float[Tensor, "p i"]],
) -> Folded:
    """Coordinates of ``W x + b``.

    Args:
        weight: W.
        bias: b; None: 0.
        before: x of codes.
    """
    basis, factor = _factors(weight if bias is None else torch.cat([weight, bias[:, None]], dim=1))
    inner = factor[:, : weight.shape[1]].contiguous()
    constant = None if bias is None else factor[:, -1].contiguous()
    return Folded(basis, lambda codes: linear(before(codes), inner, constant))


def fold_rows(
    rows: Float[Tensor, "m e"], which: Callable[[Float[Tensor, "p d"]], Tensor]
) -> Folded:
    """Coordinates of one row of a table each.

    Args:
        rows: Of the table.
        which: The row of each code.
    """
    basis, factor = _factors(rows.T)
    return Folded(basis, lambda codes: factor.T[which(codes)])


def _factors(columns: Float[Tensor, "e i"]) -> tuple[Float[Tensor, "e r"], Float[Tensor, "r i"]]:
    # In float64: what is rounded is the factors alone, as weights are.
    basis, factor = torch.linalg.qr(columns.detach().double())
    return basis.to(columns.dtype), factor.to(columns.dtype)
