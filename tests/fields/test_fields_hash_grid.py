"""Hash grids against a loop over points, grids and corners, and their gradient against finite differences."""

from itertools import product

import pytest
import torch

from vlgs.fields.hash_grid import GridConfig, HashGrid, contract, interpolate
from vlgs.ops.row_sums import row_sums_backward

SMALL = GridConfig(levels=3, features=2, coarsest=2, finest=9, log2_table=6)
"""The first grid has a row for each of its 27 corners, the others share 64."""


def by_hand(grid: HashGrid, point: torch.Tensor) -> torch.Tensor:
    found, start = [], 0
    for cells, rows in zip(grid.config.resolutions, grid.config.rows, strict=True):
        place = [float(x) * cells for x in point]
        low = [min(int(x), cells - 1) for x in place]
        total = torch.zeros(grid.config.features, dtype=grid.table.dtype)
        for corner in product((0, 1), repeat=3):
            x, y, z = (a + b for a, b in zip(low, corner, strict=True))
            weight = 1.0
            for at, a, b in zip(place, low, corner, strict=True):
                weight *= at - a if b else 1 - (at - a)
            if rows == (cells + 1) ** 3:
                row = x + (cells + 1) * (y + (cells + 1) * z)
            else:
                row = (x ^ (y * 2654435761) ^ (z * 805459861)) % rows
            total = total + weight * grid.table[start + row]
        found.append(total)
        start += rows
    return torch.cat(found)


def test_features_are_those_of_a_loop_over_corners():
    grid = HashGrid(SMALL, torch.Generator().manual_seed(0)).double()
    assert SMALL.rows == [27, 64, 64]
    points = torch.rand(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    points[0], points[1] = 0, 1  # corners of the cube
    want = torch.stack([by_hand(grid, point) for point in points])
    torch.testing.assert_close(grid(points), want, rtol=1e-12, atol=1e-16)


def test_what_lies_beside_the_cube_counts_as_on_its_side():
    grid = HashGrid(SMALL)
    outside = torch.tensor([[-0.5, 0.3, 2.0]])
    assert torch.equal(grid(outside), grid(outside.clamp(0, 1)))


def test_the_gradient_is_that_of_finite_differences():
    grid = HashGrid(SMALL).double()
    rows, weights = grid.corners(torch.rand(5, 3, dtype=torch.float64))
    table = torch.rand(len(grid.table), 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: interpolate(t, rows, weights), (table,))


@pytest.mark.parametrize("features", [2, 3, 8])
@pytest.mark.parametrize("threads", [1, 3])
def test_the_gradient_is_added_in_the_order_of_the_points(features: int, threads: int):
    """PyTorch's `bincount` does so too, a feature at a time."""
    config = GridConfig(levels=3, features=features, coarsest=2, finest=9, log2_table=6)
    grid = HashGrid(config, torch.Generator().manual_seed(0))
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(1))
    upstream = torch.randn(300, 3 * features, generator=torch.Generator().manual_seed(2))
    rows, weights = grid.corners(points)
    by_grid = upstream.view(300, 3, features).transpose(0, 1).reshape(-1, features)
    want = [
        torch.bincount(rows.flatten(), (channel[:, None] * weights).flatten(), len(grid.table))
        for channel in by_grid.unbind(1)
    ]
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        (got,) = torch.autograd.grad(grid(points), grid.table, upstream)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(got, torch.stack(want, dim=1))


def test_rows_of_other_grids_are_refused():
    begins, weights, d_sums = torch.tensor([0, 4]), torch.ones(2, 8), torch.ones(1, 2, 3)
    rows = torch.tensor([[0, 1, 2, 3] * 2, [4, 5, 6, 7] * 2]).int()
    assert row_sums_backward(begins, rows, weights, d_sums, 8).tolist() == [[2.0] * 3] * 8
    for place, row in ((0, 4), (1, 3), (0, -1), (1, 8)):
        odd = rows.clone()
        odd[place, 5] = row
        with pytest.raises(ValueError, match="rows must be those of their grids, got 1 of others"):
            row_sums_backward(begins, odd, weights, d_sums, 8)
    with pytest.raises(ValueError, match=r"rows and weights must be \[4, 8\]"):
        row_sums_backward(begins, rows, weights, torch.ones(2, 2, 3), 8)


def test_released_sizes():
    """LERF's and FMGS's: 12 levels x 8 features twice, 192 numbers; a table of 2^19 rows only where a grid has more corners."""
    first, second = GridConfig(12, 8, 16, 128, 19), GridConfig(12, 8, 128, 512, 19)
    assert first.width + second.width == 192
    assert (first.resolutions[0], first.resolutions[-1]) == (16, 128)
    assert (second.resolutions[0], second.resolutions[-1]) == (128, 512)
    assert first.rows[0] == 17**3
    assert set(second.rows) == {2**19}


def test_all_of_space_is_contracted_into_a_ball_of_radius_2():
    points = 100 * torch.randn(200, 3)
    assert (contract(points).norm(dim=1) < 2).all()
    inside = points / points.norm(dim=1, keepdim=True) * torch.rand(200, 1)
    torch.testing.assert_close(contract(inside), inside)


def test_grids_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match=r"hash grid: finest must be 16 to .*, got 8"):
        GridConfig(2, 2, 16, 8, 10)
    with pytest.raises(ValueError, match="hash grid: log2_table must be 4 to 24, got 30"):
        GridConfig(2, 2, 16, 32, 30)
