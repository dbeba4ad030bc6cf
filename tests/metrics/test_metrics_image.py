"""PSNR and SSIM against torchmetrics, by hand, and at the edges."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage
from torchmetrics.functional.image import (
    peak_signal_noise_ratio,
    structural_similarity_index_measure,
)

from vlgs.metrics.image import psnr, ssim


def pair(h: int = 31, w: int = 44) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    truth = torch.rand(h, w, 3, generator=rng)
    return (truth + 0.1 * torch.randn(h, w, 3, generator=rng)).clamp(0, 1), truth


def test_psnr_by_hand_and_of_equal_images():
    assert psnr(torch.zeros(4, 4, 3), torch.full((4, 4, 3), 0.5)) == pytest.approx(
        20 * math.log10(2)
    )
    assert psnr(torch.ones(4, 4, 3), torch.ones(4, 4, 3)) == math.inf


def test_both_agree_with_torchmetrics():
    image, truth = pair()
    assert psnr(image, truth) == pytest.approx(
        peak_signal_noise_ratio(image, truth, data_range=1.0).item(), abs=1e-4
    )
    batch = [x.double().permute(2, 0, 1)[None] for x in (image, truth)]
    want = structural_similarity_index_measure(batch[0], batch[1], data_range=1.0)
    assert isinstance(want, torch.Tensor)
    assert ssim(image, truth) == pytest.approx(want.item(), abs=1e-9)


@pytest.mark.parametrize("size", [(31, 44), (65, 130)])  # in one product, and in several
def test_zero_padded_ssim_agrees_with_scipy(size: tuple[int, int]):
    image, truth = (x.double().numpy() for x in pair(*size))
    window = np.exp(-(np.arange(-5, 6) ** 2) / 4.5)
    window /= window.sum()

    def mean(x: np.ndarray) -> np.ndarray:
        for axis in (0, 1):
            x = ndimage.correlate1d(x, window, axis=axis, mode="constant")
        return x

    ma, mb = mean(image), mean(truth)
    va, vb, ab = mean(image**2) - ma**2, mean(truth**2) - mb**2, mean(image * truth) - ma * mb
    want = ((2 * ma * mb + 1e-4) * (2 * ab + 9e-4)) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    got = ssim(*pair(*size), border="zero")
    assert got == pytest.approx(want.mean(), abs=1e-9)
    assert ssim(*pair(*size)) != pytest.approx(got, abs=1e-5)


def test_borders_by_hand():
    # Ones against a half: in the middle 2ab/(a^2+b^2) = 0.8 and no variance; the zero border adds variance of equal shape.
    ones, half = torch.ones(21, 21, 3), torch.full((21, 21, 3), 0.5)
    flat = (2 * 0.5 + 1e-4) / (1 + 0.25 + 1e-4)
    assert ssim(ones, half) == pytest.approx(flat, abs=1e-9)
    middle = torch.zeros(21, 21, dtype=torch.bool)
    middle[5:-5, 5:-5] = True
    assert ssim(ones, half, middle, border="zero") == pytest.approx(flat, abs=1e-9)
    assert ssim(ones, half, border="zero") != pytest.approx(flat, abs=1e-3)


def test_only_valid_pixels_count():
    image, truth = pair()
    valid = torch.zeros(31, 44, dtype=torch.bool)
    valid[:, :20] = True
    spoilt = image.clone()
    spoilt[:, 30:] = 0  # more than half a window away from the valid part
    assert psnr(spoilt, truth, valid) == psnr(image[:, :20], truth[:, :20])
    assert ssim(spoilt, truth, valid) == pytest.approx(ssim(image, truth, valid), abs=1e-12)


def test_no_valid_pixel_is_not_available():
    image, truth = pair()
    valid = torch.zeros(31, 44, dtype=torch.bool)
    assert psnr(image, truth, valid) is None
    assert ssim(image, truth, valid) is None


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_ssim_of_flat_images_stays_in_range(level: float):
    flat = torch.full((20, 20, 3), level)
    assert ssim(flat, flat) == pytest.approx(1, abs=1e-6)
    nearly = ssim(flat, (flat + 1e-7).clamp(0, 1))
    assert nearly is not None
    assert 0.999 < nearly <= 1


def test_ssim_of_the_negative_is_negative():
    image, _ = pair()
    value = ssim(image, 1 - image)
    assert value is not None
    assert -1 <= value < -0.5


def test_tiny_images_are_refused_by_ssim():
    with pytest.raises(ValueError, match="at least 6x6 pixels, got 5x9"):
        ssim(torch.zeros(5, 9, 3), torch.zeros(5, 9, 3))
