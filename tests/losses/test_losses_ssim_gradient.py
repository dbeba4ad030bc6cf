"""SSIM and the loss that is made of it against their definition in plain torch, differentiated by autograd."""

import hashlib
import math
import os
import subprocess
import sys
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from vlgs.losses import l1_dssim, ssim, ssim_map
from vlgs.ops import _csrc

SIZES = [(1, 1, 3), (1, 17, 1), (9, 1, 5), (4, 30, 3), (12, 11, 1), (37, 21, 5)]


def images(*shape: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(sum(shape))
    a = torch.rand(*shape, generator=g, dtype=dtype)
    b = (a + 0.2 * torch.randn(*shape, generator=g, dtype=dtype)).clamp(0, 1)
    return a.requires_grad_(), b.requires_grad_()


def blurred(image: Tensor) -> Tensor:
    """[h, w, c] through the whole window of 11 x 11 pixels at once, with zeros beyond the edge."""
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    weights = torch.exp(-(offsets[:, None] ** 2 + offsets**2) / 4.5)
    kernel = (weights / weights.sum())[None, None]
    return conv2d(image.permute(2, 0, 1)[:, None], kernel, padding=5)[:, 0].permute(1, 2, 0)


def defined(a: Tensor, b: Tensor) -> Tensor:
    """The five moments of Wang et al. 2004, nothing clamped: variances of doubles in [0, 1] come out well enough."""
    mean_a, mean_b = blurred(a), blurred(b)
    var_a, var_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    covariance = blurred(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
    return luminance * (2 * covariance + 9e-4) / (var_a + var_b + 9e-4)


def masked(a: Tensor, b: Tensor, valid: Tensor | None) -> Tensor:
    """0.8 L1 + 0.2 (1 - SSIM) over the pixels of a mask, beyond which both images are black."""
    if valid is None:
        valid = torch.ones(a.shape[:2], dtype=torch.bool)
    a, b = a.where(valid[..., None], 0), b.where(valid[..., None], 0)
    error = 0.8 * (a - b).abs() + 0.2 * (1 - defined(a, b))
    return error[valid].sum() / max(int(valid.sum()) * a.shape[-1], 1)


def with_gradients(function: Callable[..., Tensor], *leaves: Tensor) -> tuple[Tensor, ...]:
    """What comes out, and its gradients for an upstream that is different everywhere and lies crosswise in memory."""
    out = function(*leaves)
    crosswise = tuple(reversed(range(out.ndim)))
    upstream = torch.linspace(-1, 2, out.numel(), dtype=out.dtype).sin().reshape(out.shape[::-1])
    return (out.detach(), *torch.autograd.grad(out, leaves, upstream.permute(crosswise)))


@pytest.mark.parametrize("size", SIZES)
def test_map_and_gradients_are_those_of_the_definition(size: tuple[int, int, int]):
    got, want = with_gradients(ssim_map, *images(*size)), with_gradients(defined, *images(*size))
    torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("share", [None, 0.0, 0.6, 1.0])
def test_loss_and_gradients_are_those_of_the_definition(
    size: tuple[int, int, int], share: float | None
):
    a, b = images(*size)
    g = torch.Generator().manual_seed(1)
    valid = None if share is None else torch.rand(size[:2], generator=g) < share
    want = with_gradients(lambda a, b: masked(a, b, valid), a, b)
    if valid is not None:  # what is not looked at may be anything
        a.data[~valid], b.data[~valid] = math.inf, math.nan
    got = with_gradients(lambda a, b: l1_dssim(a, b, valid), a, b)
    torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-11)


def test_either_image_alone_has_the_gradient_that_it_has_beside_the_other():
    a, b = images(13, 12, 3)
    for function in (ssim, l1_dssim):
        d_a, d_b = torch.autograd.grad(function(a, b), (a, b))
        assert torch.equal(torch.autograd.grad(function(a, b.detach()), a)[0], d_a)
        assert torch.equal(torch.autograd.grad(function(a.detach(), b), b)[0], d_b)


def in_plain_torch(a: Tensor, b: Tensor) -> Tensor:
    """`ssim_map` in its own order of sums, down the columns and then along the rows, with torch's clamp."""
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    weights = torch.exp(-(offsets**2) / 4.5)
    taps = (weights / weights.sum()).to(a.dtype)

    def window(image: Tensor) -> Tensor:
        for dim in (0, 1):
            edge = torch.zeros_like(image.narrow(dim, 0, 1)).repeat_interleave(5, dim)
            padded = torch.cat([edge, image, edge], dim)
            total = torch.zeros_like(image)
            for k, tap in enumerate(taps):
                total = total + tap * padded.narrow(dim, k, image.shape[dim])
            image = total
        return image

    p, q = a + b, a - b
    p2, q2 = window(p).square(), window(q).square()
    var_p, var_q = window(p * p) - p2, window(q * q) - q2
    assert (var_p < 0).float().mean() > 0.1, "the clamp must be active for this test"
    assert (var_p > 0).float().mean() > 0.1
    var_p, var_q = var_p.clamp_min(0), var_q.clamp_min(0)
    structure = (var_p - var_q + 1.8e-3) / (var_p + var_q + 1.8e-3)
    return (p2 - q2 + 2e-4) / (p2 + q2 + 2e-4) * structure


def test_no_gradient_passes_a_clamped_variance():
    """Where a + b is bright and flat its variance is mere rounding, of either sign; a - b is not flat."""
    noise = torch.rand(40, 30, 3, generator=torch.Generator().manual_seed(0))
    a, b = (30 + noise).requires_grad_(), (30 - noise).requires_grad_()
    got, want = with_gradients(ssim_map, a, b), with_gradients(in_plain_torch, a, b)
    assert torch.equal(got[0], want[0])
    for mine, theirs in zip(got[1:], want[1:], strict=True):
        assert (mine - theirs).norm() < 1e-4 * theirs.norm()


def of_a_tall_image() -> list[Tensor]:
    """Enough rows for several threads."""
    a, b = images(133, 21, 3, dtype=torch.float32)
    valid = torch.rand(133, 21, generator=torch.Generator().manual_seed(2)) < 0.9
    loss = with_gradients(lambda a, b: l1_dssim(a, b, valid), a, b)
    return [*with_gradients(ssim_map, a, b), *loss]


def digest() -> str:
    """Of every bit, on whatever instruction set this process has."""
    return hashlib.sha256(b"".join(t.numpy().tobytes() for t in of_a_tall_image())).hexdigest()


def test_threads_and_repeats_do_not_change_a_bit():
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3, 4, 2):
            torch.set_num_threads(threads)
            results.append(of_a_tall_image())
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.slow
def test_every_instruction_set_has_the_same_bits():
    others = [isa for isa in _csrc.isas().split() if isa != _csrc.isa()]
    if not others:
        pytest.skip(
            f"this build and this machine have {_csrc.isas()}; VLGS_ISAS chooses what is built"
        )
    code = "from tests.losses.test_losses_ssim_gradient import digest; print(digest())"
    for isa in others:
        done = subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"VLGS_ISA": isa},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert done.stdout.strip() == digest(), isa


def test_a_pixel_that_is_not_a_number_spoils_the_gradient_of_what_it_reaches_alone():
    a, b = images(40, 41, 3)
    a.data[20, 21, 1] = math.nan
    (d_a,) = torch.autograd.grad(ssim_map(a, b).nansum(), a)
    spoiled = d_a.isnan()
    assert spoiled[10:31, 11:32, 1].all()
    assert spoiled.sum() == 21 * 21
    assert l1_dssim(a, b).isnan()


def test_images_without_pixels_are_refused_by_name():
    empty = torch.zeros(0, 4, 3)
    with pytest.raises(
        ValueError, match=r"l1_dssim: images must have pixels, got shape \(0, 4, 3\)"
    ):
        l1_dssim(empty, empty)
