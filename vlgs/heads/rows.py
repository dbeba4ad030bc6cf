"""Linear maps of many rows in blocks of fixed size, so that gradients have the same bits on any number of threads.

One matrix product over all rows is cut by the BLAS library into as many parts as there are threads, and the gradient of a weight,
a sum over all rows, then depends on their number. A batch of equal products is not cut any further.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

BLOCK = 512
"""Rows of a block; of fewer than two blocks the halves."""


def linear_rows(
    rows: Float[Tensor, "*b i"],
    weight: Float[Tensor, "o i"],
    bias: Float[Tensor, " o"] | None = None,
) -> Float[Tensor, "*b o"]:
    """``W x + b`` for every row x.

    Example:
        >>> linear_rows(torch.ones(3, 2), torch.tensor([[1.0, 2.0]]), torch.tensor([0.5]))
        tensor([[3.5000],
                [3.5000],
                [3.5000]])
    """
    flat = rows.reshape(-1, rows.shape[-1])
    blocks = in_blocks(flat)
    batch = weight.T.expand(len(blocks), -1, -1)
    made = torch.bmm(blocks, batch) if bias is None else torch.baddbmm(bias, blocks, batch)
    return made.flatten(0, 1)[: len(flat)].reshape(*rows.shape[:-1], len(weight))


def in_blocks(rows: Float[Tensor, "n i"]) -> Float[Tensor, "blocks size i"]:
    """Rows in at least two blocks of one size, with zeros after the last row."""
    # A batch of one counts as a single product, which may be cut.
    size = min(BLOCK, math.ceil(max(len(rows), 2) / 2))
    count = max(2, math.ceil(len(rows) / size))
    return pad(rows, (0, 0, 0, count * size - len(rows))).unflatten(0, (count, size))


def for_error(
    gradients: Sequence[Tensor], toward: Float[Tensor, ""], d_error: Float[Tensor, ""]
) -> list[Tensor]:
    """Gradients that were formed where ``toward`` is the gradient by the error, for another one. For the same one they stay as they are, to the bit."""
    if torch.equal(d_error, toward):
        return [*gradients]
    return [gradient * (d_error / toward) for gradient in gradients]


def linear_gradients(
    d_made: Float[Tensor, "blocks size o"],
    blocks: Float[Tensor, "blocks size i"],
    weight: Float[Tensor, "o i"],
) -> tuple[
    Float[Tensor, "blocks size i"],
    Float[Tensor, "o i"],
    Float[Tensor, " o"],
]:
    """Gradients by the blocks, the weight and the bias of ``W x + b``, bit for bit those that autograd forms in `linear_rows`."""
    d_blocks = torch.bmm(d_made, weight.expand(len(blocks), -1, -1))
    d_weight = torch.bmm(blocks.transpose(1, 2), d_made).sum(0).T
    return d_blocks, d_weight, d_made.sum((0, 1))


def layers(network: nn.Sequential, rows: Float[Tensor, "*b i"]) -> Float[Tensor, "*b o"]:
    """A network of linear maps and what acts on each number by itself, by `linear_rows`."""
    for layer in network:
        if isinstance(layer, nn.Linear):
            rows = linear_rows(rows, layer.weight, layer.bias)
        else:
            rows = layer(rows)
    return rows
