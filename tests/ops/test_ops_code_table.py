"""Looking up in a table over codes: against its definition in plain torch, corner by corner."""

import math

import pytest
import torch
from torch import Tensor

from vlgs.ops.code_table import LANES, code_table

REACH = 1.5


def definition(codes: Tensor, places: Tensor, rows: Tensor, words: int) -> Tensor:
    """Tent functions of all nodes, each by itself."""
    side = len(places)
    nodes = torch.linspace(-REACH, REACH, side, dtype=torch.float64)
    found = []
    for code in codes.double():
        if not ((code >= -REACH) & (code < REACH)).all():
            found.append(torch.full((words,), math.nan))
            continue
        at = (code + REACH) / (2 * REACH) * (side - 1)
        tents = (1 - (at[:, None] - torch.arange(side)).abs()).clamp_min(0)
        weights = torch.einsum("i,j,k->ijk", *tents)
        cell = at.floor().long()
        corners = places[tuple(slice(int(c), int(c) + 2) for c in cell)]
        if (corners < 0).any():
            found.append(torch.full((words,), math.nan))
            continue
        inside = weights[places >= 0]
        found.append(inside @ rows.double()[places[places >= 0].long(), :words])
    assert len(nodes) == side
    return torch.stack(found, dim=1) if found else torch.empty(words, 0)


def table(side: int, words: int, holes: float, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(side + words)
    there = torch.rand(side, side, side, generator=generator) >= holes
    places = torch.full((side, side, side), -1, dtype=torch.int32)
    count = int(there.sum())
    places[there] = torch.randperm(count, generator=generator, dtype=torch.int32)
    rows = torch.randn(count, -(-words // LANES) * LANES, generator=generator, dtype=torch.float64)
    return places, rows.to(dtype)


@pytest.mark.parametrize("words", [1, 8, 11])
@pytest.mark.parametrize(("side", "holes"), [(2, 0.0), (5, 0.0), (6, 0.03)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_answers_are_those_of_the_definition(
    side: int, holes: float, words: int, dtype: torch.dtype
):
    places, rows = table(side, words, holes, dtype)
    codes = (torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) * 3.4 - 1.7).to(dtype)
    codes[:3] = torch.tensor([[-1.5, -1.5, -1.5], [1.5, 0, 0], [math.nan, 0, 0]])
    answers, lacking = code_table(codes, REACH, places, rows, words)
    wanted = definition(codes, places, rows, words)
    assert lacking == int(wanted[0].isnan().sum()) > 1
    bound = 1e-12 if dtype == torch.float64 else 1e-5
    torch.testing.assert_close(
        answers.double(), wanted.double(), equal_nan=True, rtol=0, atol=bound
    )


def test_what_is_linear_is_exact_between_nodes():
    side = 7
    axis = torch.linspace(-REACH, REACH, side)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
    slope = torch.tensor([0.5, -2.0, 1.0])
    rows = torch.zeros(side**3, LANES)
    rows[:, 0] = grid @ slope + 0.25
    places = torch.arange(side**3, dtype=torch.int32).view(side, side, side)
    codes = torch.rand(1000, 3) * 2.99 - 1.495
    answers, lacking = code_table(codes, REACH, places, rows, 1)
    assert lacking == 0
    torch.testing.assert_close(answers[0], codes @ slope + 0.25, rtol=0, atol=2e-6)


def test_threads_do_not_change_a_bit():
    places, rows = table(9, 5, 0.01, torch.float32)
    codes = torch.rand(20_000, 3) * 3.2 - 1.6
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(code_table(codes, REACH, places, rows, 5))
    finally:
        torch.set_num_threads(threads)
    for other in found[1:]:
        assert other.lacking == found[0].lacking
        assert other.answers.nan_to_num(7).equal(found[0].answers.nan_to_num(7))


def test_rows_that_are_not_there_are_never_read():
    places = torch.full((2, 2, 2), 3, dtype=torch.int32)
    answers, lacking = code_table(torch.zeros(4, 3), REACH, places, torch.zeros(3, LANES), 2)
    assert lacking == 4
    assert answers.isnan().all()
    empty = code_table(torch.zeros(0, 3), REACH, places, torch.zeros(0, LANES), 2)
    assert empty.answers.shape == (2, 0)
    assert empty.lacking == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"places": torch.zeros(2, 2, 2).long()}, "places must be a cube of int32"),
        ({"places": torch.zeros(1, 1, 1).int()}, "2 nodes or more on a side"),
        ({"rows": torch.zeros(1, 7)}, "rows must be torch.float32 and a multiple of 8"),
        ({"rows": torch.zeros(1, 8).double()}, "rows must be torch.float32"),
        ({"words": 9}, "enough for 9 words, got 8"),
    ],
)
def test_bad_input_is_refused_by_name(change: dict[str, object], message: str):
    given = {
        "codes": torch.zeros(4, 3),
        "places": torch.zeros(2, 2, 2, dtype=torch.int32),
        "rows": torch.zeros(1, 8),
        "words": 2,
    }
    with pytest.raises(ValueError, match=message):
        code_table(reach=REACH, **{**given, **change})  # pyright: ignore[reportArgumentType]
