"""Losses of maps that are never made: their gradients are those of plain torch, bit for bit."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn.functional import huber_loss, l1_loss

from vlgs.heads.rows import linear_rows
from vlgs.objectives.choice import CHUNK, choose
from vlgs.objectives.mapped_error import mapped_l1
from vlgs.ops import neighbours
from vlgs.ops.huber import huber_sum
from vlgs.ops.mapped_error import mapped_error_
from vlgs.ops.neighbours import neighbour_products
from vlgs.ops.radam import _PART, Moments, Rates, radam_step
from vlgs.training.radam import RAdam


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def gradients(loss: Callable[..., Tensor], *values: Tensor, factor: float = 1.0) -> list[Tensor]:
    """Of a loss and a factor."""
    own = [value.clone().requires_grad_() for value in values]
    return [*torch.autograd.grad(factor * loss(*own), own)]


def plain_choice(codes: Tensor, weight: Tensor, bias: Tensor, right: Tensor) -> Tensor:
    """Of a chunk: the softmax, the unit vector that is right, their squared distance."""
    odds = linear_rows(codes, weight, bias).log_softmax(dim=-1).exp()
    return (odds.square().sum(dim=-1) - 2 * odds.gather(1, right[:, None])[:, 0] + 1).sum()


@pytest.mark.parametrize("pixels", [1, 600, CHUNK + 1])
def test_the_choice_of_rows_is_that_of_plain_torch(pixels: int):
    values = draw(pixels, 5), draw(70, 5, seed=1), draw(70, seed=2)
    right = torch.arange(pixels) % 70

    def plain(codes: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        parts = zip(codes.split(CHUNK), right.split(CHUNK), strict=True)
        sums = [plain_choice(some, weight, bias, own) for some, own in parts]
        return torch.stack(sums).sum() / (pixels * 70)

    def quick(counts: float) -> Callable[..., Tensor]:
        return lambda codes, weight, bias: choose(codes, weight, bias, right, counts)[0]

    assert torch.equal(quick(1.0)(*values), plain(*values))
    codes, weight, bias = values
    best = choose(codes, weight, bias, right)[1]
    assert torch.equal(best, linear_rows(codes, weight, bias).argmax(dim=1))
    want = gradients(plain, *values, factor=50.0)
    assert all(map(torch.equal, gradients(quick(50.0), *values, factor=50.0), want))
    torch.testing.assert_close(gradients(quick(1.0), *values, factor=50.0), want)


@pytest.mark.parametrize("pixels", [1, 600, 1100])
def test_the_error_of_mapped_codes_is_that_of_plain_torch(pixels: int):
    values = draw(pixels, 6), draw(40, 6, seed=1), draw(40, seed=2)
    table, which = draw(7, 40, seed=3), torch.arange(pixels) % 7
    table[0] = linear_rows(*values)[0].detach()  # nothing pulls where there is no error

    def plain(*given: Tensor) -> Tensor:
        return l1_loss(linear_rows(*given), table[which])

    def quick(counts: float) -> Callable[..., Tensor]:
        return lambda codes, weight, bias: mapped_l1(codes, weight, bias, table, which, counts)

    torch.testing.assert_close(quick(1.0)(*values), plain(*values))
    assert all(map(torch.equal, gradients(quick(1.0), *values), gradients(plain, *values)))
    want = gradients(plain, *values, factor=0.3)
    assert all(map(torch.equal, gradients(quick(0.3), *values, factor=0.3), want))
    torch.testing.assert_close(gradients(quick(1.0), *values, factor=0.3), want)


def test_mapped_errors_of_targets_that_are_not_there_are_refused():
    made, bias, table = draw(4, 3), draw(3), draw(2, 3)
    with pytest.raises(ValueError, match="rows must be of 2, got some from 0 to 2"):
        mapped_error_(made, bias, table, torch.tensor([0, 2]), 1.0)
    with pytest.raises(ValueError, match="no more than 4 pixels"):
        mapped_error_(made, bias, table, torch.zeros(5, dtype=torch.long), 1.0)
    assert mapped_error_(made, bias, table, torch.tensor([], dtype=torch.long), 1.0) == 0


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("size", [(1, 1, 3), (9, 70, 19)])
def test_hubers_loss_is_that_of_plain_torch(size: tuple[int, int, int], threads: int):
    whole, target = 2 * draw(*size[:2], size[2] + 4), draw(*size, seed=1)
    valid = draw(*size[:2], seed=2) > -0.5
    valid[0, 0] = True
    target[~valid] = torch.nan  # is not read

    def plain(image: Tensor) -> Tensor:
        return huber_loss(image[valid], target[valid], delta=1.25, reduction="sum") / 7

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for make in (
            lambda of: of[..., : size[2]],
            lambda of: of[..., 4:],
        ):  # where a wider map holds it
            image = make(whole)
            got = huber_sum(image, target, valid, 1.25) / 7
            torch.testing.assert_close(got, plain(image))
            (own,) = gradients(lambda of: huber_sum(of, target, valid, 1.25) / 7, image, factor=0.04)  # fmt: skip
            assert torch.equal(own, gradients(plain, image, factor=0.04)[0])
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(("height", "width"), [(3, 3), (9, 4), (2, 5), (1, 1)])
@pytest.mark.parametrize("rows", [1, 4, 100])
def test_products_of_neighbours_are_those_of_plain_torch(
    height: int, width: int, rows: int, monkeypatch: pytest.MonkeyPatch
):
    image = draw(height, width, 37)
    monkeypatch.setattr(neighbours, "_NUMBERS", rows * width * 37)  # so many rows in a band

    def plain(unit: Tensor) -> Tensor:
        inner = unit[1 : height - 1, 1 : width - 1]
        shifts = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
        beside = [unit[y : y + height - 2, x : x + width - 2] for y, x in shifts]
        return torch.stack([(inner * other).sum(-1) for other in beside])

    if min(height, width) < 3:
        assert neighbour_products(image).numel() == 0
        assert not gradients(lambda unit: neighbour_products(unit).sum(), image)[0].any()
        return
    want = plain(image)
    assert torch.equal(neighbour_products(image), want)
    upstream = draw(*want.shape, seed=1)
    got, own = (
        gradients(lambda unit, f=f: (f(unit) * upstream).sum(), image)[0]
        for f in (neighbour_products, plain)
    )
    assert torch.equal(got, own)


def test_radam_in_few_passes_is_radam_of_torch():
    start = draw(2, _PART // 2 + 77), draw(3, seed=1)
    found = []
    for make in (RAdam, torch.optim.RAdam):
        own = [torch.nn.Parameter(value.clone()) for value in (*start, torch.zeros(4))]
        optimizer = make(own, lr=1e-2, betas=(0.9, 0.99), eps=1e-15, weight_decay=1e-3)
        for step in range(9):  # rectified from the sixth on
            own[0].grad = draw(*own[0].T.shape, seed=step).T
            own[1].grad = draw(3, seed=step + 9)  # the last one has none
            optimizer.step()
        states = optimizer.state_dict()["state"]
        found.append([*own, *(value for state in states.values() for value in state.values())])
        assert [*states] == [0, 1]
    assert all(map(torch.equal, *found))
    assert not torch.equal(found[0][0], start[0])
    with pytest.raises(ValueError, match="closure must be None"):
        RAdam([torch.nn.Parameter(start[1])]).step(lambda: 0.0)


@pytest.mark.parametrize("decay", [0.0, 1e-9])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_radam_of_gradients_of_all_sizes_is_that_of_torch(dtype: torch.dtype, decay: float):
    """Most rows of a hash grid have no gradient in a step; others differ by many orders."""
    found = []
    sizes = (10 ** (4 * draw(4_099, seed=1))).to(dtype)
    for own in (True, False):
        weight = torch.nn.Parameter(1e-2 * draw(4_099).to(dtype))
        mean, square = torch.zeros_like(weight), torch.zeros_like(weight)
        plain = torch.optim.RAdam([weight], 5e-3, (0.9, 0.999), 1e-15, decay)
        for step in range(1, 12):
            weight.grad = (
                sizes * draw(4_099, seed=step).to(dtype) * (draw(4_099, seed=99 + step) > 0)
            )
            if own:
                moments, rates = (
                    Moments(mean, square),
                    Rates(5e-3, 0.9, 0.999, 1e-15, decay, float(step)),
                )
                radam_step(weight.detach(), weight.grad, moments, rates)
            else:
                plain.step()
        state = plain.state[weight]
        found.append([weight, mean, square] if own else [weight, state["exp_avg"], state["exp_avg_sq"]])  # fmt: skip
    assert all(map(torch.equal, *found))
