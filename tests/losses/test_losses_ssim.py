import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from vlgs.losses import l1_dssim, ssim, ssim_map, view_similarity


def pair(
    height: int, width: int, noise: float = 0.1, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(height * 1000 + width)
    a = torch.rand(height, width, 3, generator=g, dtype=dtype)
    return a, (a + noise * torch.randn(a.shape, generator=g, dtype=dtype)).clamp(0, 1)


def ssim_at(a: Tensor, b: Tensor, y: int, x: int) -> float:
    """Definition at one pixel of one channel [h, w]: a two-dimensional window, zeros beyond the edge, five moments."""
    total = sum(math.exp(-(i * i + j * j) / 4.5) for i in range(-5, 6) for j in range(-5, 6))
    moments = [0.0] * 5
    for i in range(max(y - 5, 0), min(y + 6, a.shape[0])):
        for j in range(max(x - 5, 0), min(x + 6, a.shape[1])):
            weight = math.exp(-((i - y) ** 2 + (j - x) ** 2) / 4.5) / total
            p, q = a[i, j].item(), b[i, j].item()
            for m, value in enumerate((p, q, p * p, q * q, p * q)):
                moments[m] += weight * value
    mean_a, mean_b, aa, bb, ab = moments
    luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
    return (
        luminance * (2 * (ab - mean_a * mean_b) + 9e-4) / (aa - mean_a**2 + bb - mean_b**2 + 9e-4)
    )


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 14), (13, 12)])
def test_equals_the_definition_one_pixel_at_a_time(height: int, width: int):
    a, b = pair(height, width)
    want = [
        [[ssim_at(a[..., c], b[..., c], y, x) for c in range(3)] for x in range(width)]
        for y in range(height)
    ]
    torch.testing.assert_close(
        ssim_map(a, b), torch.tensor(want, dtype=torch.float64), rtol=0, atol=1e-12
    )
    torch.testing.assert_close(ssim(a, b), torch.tensor(want, dtype=torch.float64).mean())


def test_agrees_with_others_where_the_window_lies_in_the_image():
    """Beyond the edge kornia and torchmetrics see the image mirrored, we see zeros as 3DGS does."""
    from kornia.metrics import ssim as kornia_ssim
    from torchmetrics.functional.image import structural_similarity_index_measure

    a, b = pair(40, 50)
    planes = a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None]
    full = structural_similarity_index_measure(
        planes[0], planes[1], data_range=1.0, return_full_image=True
    )
    for theirs in (kornia_ssim(*planes, window_size=11), full[1]):
        inside = theirs[0].permute(1, 2, 0)[5:-5, 5:-5]
        torch.testing.assert_close(ssim_map(a, b)[5:-5, 5:-5], inside, rtol=0, atol=1e-7)


@given(st.integers(1, 14), st.integers(1, 14), st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_bounded_symmetric_and_one_for_equal_images(height: int, width: int, noise: float):
    a, b = pair(height, width, noise, torch.float32)
    assert ssim(a, a).item() == 1
    assert -1 <= ssim(a, b).item() <= 1
    assert ssim(a, b).item() == pytest.approx(ssim(b, a).item(), abs=1e-6)
    flipped = ssim(a.flip(0).transpose(0, 1), b.flip(0).transpose(0, 1)).item()
    assert flipped == pytest.approx(ssim(a, b).item(), abs=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (5, 30), (40, 50)])
@pytest.mark.parametrize("level", [0.0, 0.13, 0.5, 0.7, 1.0])
def test_flat_images_in_float32(size: tuple[int, int], level: float):
    """What cancels in E[x^2] - E[x]^2 leaves neither the bounds nor the neighbourhood of float64."""
    a = torch.full((*size, 3), level)
    for b in (a, a + 1e-7, 1 - a):
        got = ssim(a, b).item()
        assert -1 <= got <= 1
        assert got == pytest.approx(ssim(a.double(), b.double()).item(), abs=1e-5)


@pytest.mark.parametrize("scale", [1.0, 1e2, 1e4])
def test_renders_far_out_of_range_stay_within_the_bounds(scale: float):
    """In float32 E[x^2] - E[x]^2 of bright flat channels is mere rounding, of either sign and larger than the constants."""
    a = (scale * torch.linspace(0.1, 1, 64)).expand(20, 20, 64).clone().requires_grad_()
    similarity = ssim_map(a, 0.9 * a.detach())
    similarity.mean().backward()
    assert similarity.min() >= -1
    assert similarity.max() <= 1
    assert a.grad is not None
    assert a.grad.isfinite().all()


@pytest.mark.parametrize("size", [(1, 1), (6, 7), (12, 3)])
def test_gradient(size: tuple[int, int]):
    a, b = pair(*size)
    assert torch.autograd.gradcheck(lambda x: ssim(x, b), (a.requires_grad_(),), fast_mode=True)


def test_equal_images_have_no_gradient():
    a = pair(12, 13)[0].requires_grad_()
    ssim(a, a.detach()).backward()
    assert a.grad is not None
    assert a.grad.abs().max() < 1e-12


def test_l1_dssim_by_hand():
    a, b = pair(12, 13)
    want = 0.8 * (a - b).abs().mean() + 0.2 * (1 - ssim(a, b))
    torch.testing.assert_close(l1_dssim(a, b), want)
    everywhere = torch.ones(12, 13, dtype=torch.bool)
    torch.testing.assert_close(l1_dssim(a, b, everywhere), want)
    assert l1_dssim(a, a).item() == 0


def test_similarity_of_views_is_never_negative_and_has_no_gradient():
    a = torch.rand(20, 20, 3, requires_grad=True)
    assert ssim(a, 1 - a).item() < -0.5
    assert view_similarity(a, 1 - a) == 0.0
    assert view_similarity(a, a) == 1.0
    assert 0 < view_similarity(a, a + 0.1) < 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [(1, 1), (4, 30), (30, 4), (11, 12), (57, 83), (133, 21)])
def test_without_a_gradient_the_map_keeps_every_bit(size: tuple[int, int], dtype: torch.dtype):
    a, b = pair(*size, dtype=dtype)
    want = ssim_map(a.clone().requires_grad_(), b).detach()
    before = torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        got = ssim_map(a, b)
        assert torch.equal(got, want)
        assert got.stride() == want.stride()  # a mean adds in the order of memory
    torch.set_num_threads(before)
    assert torch.equal(ssim_map(a.flip(1), b.transpose(0, 1).contiguous().transpose(0, 1)),
                       ssim_map(a.flip(1).contiguous(), b))  # fmt: skip


def test_a_pixel_that_is_not_finite_spoils_its_window_alone():
    a, b = pair(30, 31)
    a[15, 16, 1] = math.nan
    spoiled = ssim_map(a, b).isnan()
    assert spoiled.sum() == 11 * 11
    assert spoiled[10:21, 11:22, 1].all()
