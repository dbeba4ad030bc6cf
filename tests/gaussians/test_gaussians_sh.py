import pytest
import torch
from scipy.special import sph_harm_y

from vlgs.gaussians import rgb_to_sh, sh_to_rgb, view_color_residual


def directions(n: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(
        torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=1
    )


def real_harmonics(toward: torch.Tensor, degree: int) -> torch.Tensor:
    """Real harmonics of degrees 1 to `degree` from scipy's complex ones, with the Condon-Shortley phase 3DGS keeps."""
    x, y, z = toward.unbind(1)
    polar, azimuth = z.acos().numpy(), torch.atan2(y, x).numpy()
    columns = []
    for n in range(1, degree + 1):
        for m in range(-n, n + 1):
            value = sph_harm_y(n, abs(m), polar, azimuth)
            scale = 1.0 if m == 0 else 2**0.5
            columns.append(torch.from_numpy(scale * (value.imag if m < 0 else value.real)))
    return torch.stack(columns, dim=1)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_residual_matches_scipys_harmonics(degree: int):
    toward = directions(50)
    coefficients = torch.randn(50, (degree + 1) ** 2 - 1, 3, dtype=torch.float64)
    want = torch.einsum("ns,nsc->nc", real_harmonics(toward, degree), coefficients)
    torch.testing.assert_close(
        view_color_residual(coefficients, toward, degree), want, rtol=1e-12, atol=1e-12
    )


def test_colour_round_trip_and_hand_value():
    rgb = torch.rand(7, 3, dtype=torch.float64)
    torch.testing.assert_close(sh_to_rgb(rgb_to_sh(rgb)), rgb)
    grey = sh_to_rgb(torch.tensor([[1.0, 0.0, -1.0]]))
    torch.testing.assert_close(grey, torch.tensor([[0.78209479, 0.5, 0.21790521]]))


def test_degrees_above_the_active_one_are_not_read():
    coefficients = torch.randn(5, 15, 3, dtype=torch.float64)
    toward = directions(5)
    spoiled = coefficients.clone()
    spoiled[:, 3:] = torch.nan
    got = view_color_residual(spoiled, toward, 1)
    torch.testing.assert_close(got, view_color_residual(coefficients[:, :3], toward, 1))


def test_degree_zero_adds_nothing():
    assert view_color_residual(torch.zeros(4, 0, 3), torch.rand(4, 3), 0).eq(0).all()


def test_no_gaussians():
    assert view_color_residual(torch.zeros(0, 15, 3), torch.zeros(0, 3), 3).shape == (0, 3)


def test_gradients_match_finite_differences():
    coefficients = torch.randn(3, 15, 3, dtype=torch.float64, requires_grad=True)
    toward = directions(3).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda c, d: view_color_residual(c, d, 3), (coefficients, toward)
    )


@pytest.mark.parametrize(
    ("stored", "degree", "message"),
    [(3, 2, "at least 8 coefficients"), (15, 4, "degree must be"), (15, -1, "degree must be")],
)
def test_bad_degree(stored: int, degree: int, message: str):
    with pytest.raises(ValueError, match=message):
        view_color_residual(torch.zeros(1, stored, 3), torch.zeros(1, 3), degree)
