"""The blur of a map against scipy's."""

from math import ceil

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from vlgs.training.blur import blurred


@given(
    st.integers(1, 80), st.integers(1, 70), st.integers(1, 5), st.floats(0.2, 30), st.integers(0, 9)
)
def test_it_is_scipys(h: int, w: int, c: int, sigma: float, seed: int):
    image = np.random.default_rng(seed).normal(size=(h, w, c))
    far = {"mode": "constant", "truncate": ceil(3 * sigma) / sigma}
    want = gaussian_filter(image, (sigma, sigma, 0), **far)
    got = blurred(torch.from_numpy(image), sigma)
    torch.testing.assert_close(got, torch.from_numpy(want), rtol=1e-9, atol=1e-9)


def test_it_is_its_own_transpose():
    a, b = torch.randn(2, 41, 67, 3, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close((blurred(a, 1.7) * b).sum(), (a * blurred(b, 1.7)).sum())


@pytest.mark.parametrize("shape", [(150, 200, 32), (37, 33, 5)])
def test_bits_do_not_depend_on_threads(shape: tuple[int, int, int]):
    image = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(blurred(image, 1.6))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)


def test_no_width_is_no_blur():
    image = torch.randn(4, 5, 2, generator=torch.Generator().manual_seed(0))
    assert blurred(image, 0.0) is image
    torch.testing.assert_close(blurred(image, 0.1), image)
