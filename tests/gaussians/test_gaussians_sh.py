import pytest
import torch
from scipy.special import sph_harm_y

from vlgs.gaussians import rgb_to_sh, sh_to_rgb, view_color


def directions(n: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(
        torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=1
    )


EYE = torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64)


def view_color_residual(coefficients: torch.Tensor, toward: torch.Tensor, degree: int):
    """What the harmonics add to a colour that is bright enough for nothing to be clamped."""
    color = torch.full_like(toward, 100.0)
    return view_color(color, coefficients, EYE + 2.5 * toward, EYE, degree) - color


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
        view_color_residual(coefficients, toward, degree), want, rtol=1e-12, atol=1e-12 * 100
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
    assert view_color_residual(torch.zeros(4, 0, 3).double(), directions(4), 0).eq(0).all()


def test_no_gaussians():
    assert view_color_residual(
        torch.zeros(0, 15, 3).double(), torch.zeros(0, 3).double(), 3
    ).shape == (0, 3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_match_finite_differences(degree: int):
    # Colours well on either side of the clamp.
    color = torch.tensor([[9.0, -9.0, 9.0]]).double().expand(4, 3).clone().requires_grad_()
    coefficients = torch.randn(4, 15, 3, dtype=torch.float64, requires_grad=True)
    means = (EYE + 1.5 * directions(4)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda c, sh, m: view_color(c, sh, m, EYE, degree),
        (color, coefficients, means) if degree else (color, coefficients.detach(), means.detach()),
    )


def test_a_gaussian_at_the_eye_has_finite_colour_and_gradient():
    means = EYE.clone()[None].requires_grad_()
    color = view_color(torch.ones(1, 3).double(), torch.randn(1, 15, 3).double(), means, EYE, 3)
    color.sum().backward()
    assert color.isfinite().all()
    assert means.grad is not None
    assert means.grad.isfinite().all()


def test_gradients_are_the_same_bits_on_any_number_of_threads():
    leaves = [torch.randn(9001, 3), torch.randn(9001, 15, 3), torch.randn(9001, 3)]
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            c, sh, m = (leaf.clone().requires_grad_() for leaf in leaves)
            out = view_color(c, sh, m, EYE.float(), 3)
            results.append([out, *torch.autograd.grad(out.square().sum(), [c, sh, m])])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize(
    ("stored", "degree", "message"),
    [(3, 2, "at least 8 coefficients"), (15, 4, "degree must be"), (15, -1, "degree must be")],
)
def test_bad_degree(stored: int, degree: int, message: str):
    with pytest.raises(ValueError, match=message):
        view_color_residual(torch.zeros(1, stored, 3), torch.zeros(1, 3), degree)
