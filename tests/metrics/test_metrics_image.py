"""PSNR and SSIM against torchmetrics, by hand, and at the edges."""

import math

import pytest
import torch
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
    batch = [x.permute(2, 0, 1)[None] for x in (image, truth)]
    want = structural_similarity_index_measure(batch[0], batch[1], data_range=1.0)
    assert isinstance(want, torch.Tensor)
    assert ssim(image, truth) == pytest.approx(want.item(), abs=2e-3)  # it leaves the border out


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
