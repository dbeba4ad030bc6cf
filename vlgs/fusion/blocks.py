"""Gaussians in blocks of fixed size, so that a result has the same bits on any number of threads.

One matrix product over all n is cut by the BLAS library into as many parts as there are threads, and the gradient of a weight,
a sum over n, then depends on their number. A batch of equal products over fixed blocks is not cut any further.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

BLOCK = 512
"""Gaussians per block: enough for long vector loops, and few enough that padding the last block costs nothing."""


def to_blocks(rows: Float[Tensor, "n c"]) -> Float[Tensor, "b c m"]:
    """Channels by Gaussians in blocks of `BLOCK`, filled up with zeros.

    There are two blocks at least: a batch of one counts as a single product, which may be cut.
    """
    count = max(2, math.ceil(len(rows) / BLOCK))
    missing = count * BLOCK - len(rows)
    return pad(rows, (0, 0, 0, missing)).unflatten(0, (count, BLOCK)).mT


def from_blocks(blocks: Float[Tensor, "b c m"], n: int) -> Float[Tensor, "n c"]:
    """The first n Gaussians of the blocks, one per row."""
    return blocks.mT.flatten(0, 1)[:n]


def linear(layer: nn.Linear, blocks: Float[Tensor, "b i m"]) -> Float[Tensor, "b o m"]:
    """``W x + b`` for every column x of every block."""
    weight = layer.weight.expand(blocks.shape[0], -1, -1)
    return torch.baddbmm(layer.bias[:, None], weight, blocks)
