"""Answers to words looked up in a table over codes of three numbers."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels

LANES = 8
"""The length of a row is a multiple of it."""


class Looked(NamedTuple):
    """What a table says of codes."""

    answers: Float[Tensor, "k p"]
    """NaN where it says nothing."""
    lacking: int
    """Of how many codes."""


def code_table(
    codes: Float[Tensor, "p 3"],
    reach: float,
    places: Int[Tensor, "side side side"],
    rows: Float[Tensor, "m padded"],
    words: int,
) -> Looked:
    """Answers between the nodes of a cube, linear along each axis; tests/ops/test_ops_code_table.py has the definition in plain torch.

    Args:
        codes: Where.
        reach: The cube is from minus to plus this, on every axis; its upper faces are outside.
        places: int32; the row of each node, -1 where it has none.
        rows: The first `words` numbers are answers; the others fill it up to a multiple of `LANES`.
        words: How many answers there are.

    Raises:
        ValueError: If a shape or a type is not so.
    """
    side, padded = places.shape[0], rows.shape[-1]
    if codes.dim() != 2 or codes.shape[1] != 3:
        raise ValueError(f"code_table: codes must have 3 numbers, got shape {list(codes.shape)}")
    if places.dtype != torch.int32 or places.shape != (side,) * 3 or side < 2:
        raise ValueError(
            f"code_table: places must be a cube of int32 with 2 nodes or more on a side, got {list(places.shape)} of {places.dtype}"
        )
    if padded % LANES or not 0 < words <= padded or rows.dtype != codes.dtype:
        raise ValueError(
            f"code_table: rows must be {codes.dtype} and a multiple of {LANES} long, enough for {words} words, got {padded} of {rows.dtype}"
        )
    return KERNELS.of(codes)(codes, reach, places, rows, words)


def _on_cpu(codes: Tensor, reach: float, places: Tensor, rows: Tensor, words: int) -> Looked:
    answers = codes.new_empty(words, len(codes))
    per_unit = (len(places) - 1) / (2 * reach)
    given, table = codes.contiguous(), (places.contiguous(), rows.contiguous())
    lacking = _csrc.code_table(
        *arrays(given), -reach, per_unit, *arrays(*table, answers), torch.get_num_threads()
    )
    return Looked(answers, lacking)


KERNELS = Kernels("code_table", cpu=_on_cpu)
