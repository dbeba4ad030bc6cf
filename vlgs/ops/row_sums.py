"""The way back from weighted sums of rows of tables, such as those of a hash grid."""

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels


def row_sums_backward(
    begins: Int64[Tensor, " l"],
    rows: Int32[Tensor, "nl 8"],
    weights: Float[Tensor, "nl 8"],
    d_sums: Float[Tensor, "n l f"],
    count: int,
) -> Float[Tensor, "r f"]:
    """Gradient of a table of l grids with rows of their own, of each of which every point has a sum.

    Terms are added in the order of the points, so that the bits are the same for any number of threads.

    Args:
        begins: First row of each grid, ascending from 0.
        rows: Of the table, grid by grid.
        weights: What they count.
        d_sums: Gradient of the sums.
        count: Rows of the table.

    Raises:
        ValueError: If a shape does not fit, or a row is not one of its grid.
    """
    grids, points = len(begins), len(d_sums)
    if rows.shape != (grids * points, 8) or weights.shape != rows.shape or d_sums.dim() != 3 or d_sums.shape[1] != grids:  # fmt: skip
        raise ValueError(
            f"row_sums: rows and weights must be [{grids * points}, 8] for gradients [n, {grids}, f], got "
            f"{list(rows.shape)}, {list(weights.shape)} and {list(d_sums.shape)}"
        )
    return KERNELS.of(d_sums)(begins, rows, weights, d_sums, count)


def _on_cpu(
    begins: Tensor, rows: Tensor, weights: Tensor, d_sums: Tensor, count: int
) -> Float[Tensor, "r f"]:
    d_table = d_sums.new_empty(count, d_sums.shape[2])
    strays = _csrc.row_sums_backward(
        *arrays(weights.contiguous(), rows.contiguous(), begins, d_sums.contiguous(), d_table),
        torch.get_num_threads(),
    )
    if strays:
        raise ValueError(f"row_sums: rows must be those of their grids, got {strays} of others")
    return d_table


KERNELS = Kernels("row_sums", cpu=_on_cpu)
