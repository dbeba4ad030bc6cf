import math
from pathlib import Path

import jaxtyping
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import l1_loss

from vlgs.losses import l1_dssim, masked_cosine, masked_l1, masked_mse, ssim

CONF = Path(__file__).parents[2] / "conf" / "loss"
PIXELWISE = [masked_mse, masked_l1, masked_cosine]
VALID = torch.tensor([[True, False], [True, True], [False, True]])


def maps(seed: int = 0, channels: int = 3) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    render, target = torch.randn(2, 3, 2, channels, generator=g, dtype=torch.float64)
    return render.requires_grad_(), target


def test_by_hand():
    render = torch.tensor([[[1.0, 2.0], [9.0, 9.0]]])
    target = torch.tensor([[[3.0, 1.0], [0.0, 0.0]]])
    valid = torch.tensor([[True, False]])
    assert masked_mse(render, target, valid).item() == 2.5  # (4 + 1) / 2
    assert masked_l1(render, target, valid).item() == 1.5
    assert masked_cosine(render, target, valid).item() == pytest.approx(1 - 5 / math.sqrt(50))
    assert masked_mse(render, target, valid, "all").item() == 1.25
    assert masked_l1(render, target, valid, "all").item() == 0.75
    assert masked_cosine(render, target, valid, "all").item() == pytest.approx(
        (1 - 5 / math.sqrt(50)) / 2
    )


@pytest.mark.parametrize("rows", [0, 1, 3000])
def test_absolute_error_is_that_of_torch_bit_for_bit(rows: int):
    g = torch.Generator().manual_seed(rows)
    render, target = torch.randn(2, 1, rows, 40, generator=g)
    target[:, ::2, ::3] = render[:, ::2, ::3]  # no slope there
    found = []
    for error in (masked_l1, l1_loss):
        sides = [render.clone().requires_grad_(), target.clone().requires_grad_()]
        loss = 0.37 * error(sides[0], sides[1])
        found.append([loss.detach(), *torch.autograd.grad(loss, sides)])
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("pixels", ["valid", "all"])
@pytest.mark.parametrize("loss", PIXELWISE)
def test_full_mask_equals_no_mask(loss, pixels):
    render, target = maps()
    full = torch.ones(3, 2, dtype=torch.bool)
    torch.testing.assert_close(loss(render, target, full, pixels), loss(render, target))


@pytest.mark.parametrize("valid", [None, VALID])
@pytest.mark.parametrize("loss", [*PIXELWISE, l1_dssim])
def test_gradient(loss, valid: Tensor | None):
    render, target = maps()
    assert torch.autograd.gradcheck(lambda x: loss(x, target, valid), (render,), fast_mode=True)


@pytest.mark.parametrize("loss", [*PIXELWISE, l1_dssim])
@pytest.mark.parametrize("rubbish", [float("nan"), float("inf"), 1e30])
def test_what_stands_outside_the_mask_is_never_looked_at(loss, rubbish: float):
    render, target = maps()
    want = loss(render, target, VALID)
    (want_grad,) = torch.autograd.grad(want, render)
    dirty = target.masked_fill(~VALID[..., None], rubbish)
    got = loss(render, dirty, VALID)
    (got_grad,) = torch.autograd.grad(got, render)
    assert torch.equal(got, want)
    assert torch.equal(got_grad, want_grad)
    assert (want_grad[~VALID] == 0).all()


@pytest.mark.parametrize("loss", [*PIXELWISE, l1_dssim])
def test_no_valid_pixel_is_no_loss_and_no_gradient(loss):
    render, target = maps()
    value = loss(render, target, torch.zeros(3, 2, dtype=torch.bool))
    value.backward()
    assert value.item() == 0
    assert render.grad is not None
    assert (render.grad == 0).all()


@given(st.integers(0, 10**6))
@settings(max_examples=25, deadline=None)
def test_masked_mean_is_the_mean_of_the_pixels_left(seed: int):
    render, target = maps(seed)
    valid = torch.rand(3, 2, generator=torch.Generator().manual_seed(seed)) > 0.5
    if valid.any():
        for loss in PIXELWISE:
            rows = render[valid][None], target[valid][None]
            torch.testing.assert_close(loss(render, target, valid), loss(*rows))


def test_cosine_of_parallel_opposite_and_orthogonal():
    render = torch.tensor([[[2.0, 0.0]]])
    for target, want in (([5.0, 0.0], 0.0), ([-3.0, 0.0], 2.0), ([0.0, 1.0], 1.0)):
        assert masked_cosine(render, torch.tensor([[target]])).item() == pytest.approx(want)


@pytest.mark.parametrize("scale", [0.0, 1e-40, 1e-20])
@pytest.mark.parametrize("target", [0.0, 1.0])
def test_cosine_of_vanishing_vectors_has_a_finite_gradient(scale: float, target: float):
    render = torch.full((2, 2, 3), scale, requires_grad=True)
    loss = masked_cosine(render, torch.full((2, 2, 3), target))
    loss.backward()
    assert loss.item() == pytest.approx(1)
    assert render.grad is not None
    assert render.grad.isfinite().all()
    assert (render.grad < 0).any() == (target > 0)  # codes that start at zero still learn


def test_bad_input_is_refused(monkeypatch: pytest.MonkeyPatch):
    # The run-time types would speak first.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    for loss in (*PIXELWISE, l1_dssim, ssim):
        with pytest.raises(ValueError, match=r"target must be \(2, 3, 1\), got \(3, 2, 1\)"):
            loss(torch.zeros(2, 3, 1), torch.zeros(3, 2, 1))
    for loss in (*PIXELWISE, l1_dssim):
        with pytest.raises(ValueError, match=r"valid must be \(2, 3\), got \(3, 2\)"):
            loss(torch.zeros(2, 3, 1), torch.zeros(2, 3, 1), VALID)
    with pytest.raises(ValueError, match=r"must have pixels, got shape \(0, 4, 3\)"):
        ssim(torch.zeros(0, 4, 3), torch.zeros(0, 4, 3))


def plain_mse(render: Tensor, target: Tensor, valid: Tensor | None, pixels: str) -> Tensor:
    """`masked_mse` in the words of its definition."""
    errors = (render - target).square()
    if valid is None:
        return errors.mean()
    total = torch.where(valid[..., None], errors, 0).sum()
    return total / (errors.numel() if pixels == "all" else valid.sum() * errors.shape[-1])


@pytest.mark.parametrize("pixels", ["valid", "all"])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(1, 17, 1), (13, 7, 3), (40, 31, 16), (3, 5, 512)])
def test_squared_error_is_its_definition(size: tuple[int, int, int], masked: bool, pixels):
    g = torch.Generator().manual_seed(sum(size))
    render, target = torch.randn(2, *size, generator=g, dtype=torch.float64)
    # Stretches of many lengths, as in the masks of photographs, and single pixels.
    valid = torch.rand(size[:2], generator=g).cumsum(1).sin() > -0.3 if masked else None
    for kind, tolerance in ((torch.float64, 1e-13), (torch.float32, 1e-6)):
        one, two = (render.to(kind, copy=True).requires_grad_() for _ in range(2))
        got = masked_mse(one, target.to(kind), valid, pixels)
        want = plain_mse(two, target.to(kind), valid, pixels)
        torch.testing.assert_close(got, want, rtol=tolerance, atol=0)
        got.mul(0.7).backward()
        want.mul(0.7).backward()
        torch.testing.assert_close(one.grad, two.grad, rtol=tolerance, atol=1e-20)


def test_squared_error_reaches_the_target_and_takes_any_layout():
    render, target = maps()
    assert torch.autograd.gradcheck(
        lambda a, b: masked_mse(a, b, VALID), (render, target.requires_grad_())
    )
    turned = render.detach().permute(1, 0, 2)
    assert not turned.is_contiguous()
    got = masked_mse(turned, target.permute(1, 0, 2), VALID.T)
    assert got.item() == pytest.approx(masked_mse(render, target, VALID).item(), rel=1e-14)


def test_squared_error_has_the_same_bits_for_any_number_of_threads():
    g = torch.Generator().manual_seed(0)
    render, target = torch.rand(2, 700, 401, 3, generator=g)
    valid = torch.rand(700, 401, generator=g) > 0.3
    before, seen = torch.get_num_threads(), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        leaf = render.clone().requires_grad_()
        loss = masked_mse(leaf, target, valid)
        loss.backward()
        seen.append((loss.detach(), leaf.grad))
    torch.set_num_threads(before)
    for loss, gradient in seen[1:]:
        assert torch.equal(loss, seen[0][0])
        assert torch.equal(gradient, seen[0][1])
