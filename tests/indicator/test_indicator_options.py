from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from vlgs.indicator import Fixed, Learned, Opacity, PerLevel
from vlgs.types import Gaussians

CONF = Path(__file__).parents[2] / "conf" / "indicator"


@pytest.fixture
def gaussians() -> Gaussians:
    n = 4
    return Gaussians(
        means=torch.randn(n, 3),
        quats=torch.randn(n, 4),
        scales=torch.rand(n, 3),
        opacities=torch.rand(n, requires_grad=True),
        indicators=torch.rand(n, requires_grad=True),
        sh0=torch.randn(n, 3),
        shN=torch.randn(n, 3, 3),
        features=torch.randn(n, 3),
    )


def test_learned_is_the_parameter(gaussians: Gaussians):
    assert Learned()(gaussians) is gaussians.indicators


def test_what_colour_hardly_sees_says_little(gaussians: Gaussians):
    opacities = torch.tensor([0.5, 0.1, 0.02, 0.0], requires_grad=True)
    of_language = torch.tensor(
        -100.0
    ).sigmoid()  # what a Gaussian without colour has (sharing=none)
    seen = replace(gaussians, opacities=opacities + torch.tensor([0.0, 0.0, 0.0, of_language]))
    weight, share = Learned(reach=10.0)(seen), torch.tensor([1.0, 1.0, 0.2, 1.0])
    torch.testing.assert_close(weight, gaussians.indicators * share)
    weight.sum().backward()
    assert opacities.grad is None, "language raises no opacity to be seen"
    assert gaussians.indicators.grad is not None
    torch.testing.assert_close(gaussians.indicators.grad, share)
    levels = torch.rand(4, 3)
    torch.testing.assert_close(
        PerLevel(reach=10.0)(replace(seen, indicators=levels)), levels * share[:, None]
    )


@pytest.mark.parametrize("reach", [-1.0, 1e7, float("nan")])
@pytest.mark.parametrize("kind", [Learned, PerLevel])
def test_a_reach_below_nothing_is_refused(kind: type, reach: float):
    with pytest.raises(ValueError, match=r"indicator: reach must be 0 to 1e\+06, got"):
        kind(reach=reach)


def test_opacity_is_the_very_tensor_that_colour_uses(gaussians: Gaussians):
    assert Opacity()(gaussians) is gaussians.opacities


def test_detached_opacity_gets_no_gradient(gaussians: Gaussians):
    weight = Opacity(detach=True)(gaussians)
    assert torch.equal(weight, gaussians.opacities)
    assert not weight.requires_grad


def test_copies_block_as_so_many_gaussians_in_one_place(gaussians: Gaussians):
    through = (1 - gaussians.opacities).double()
    want = 1 - through * through * through
    assert torch.allclose(Opacity(copies=3.0)(gaussians).double(), want, atol=1e-6)


def test_copies_of_what_is_solid_have_a_finite_gradient(gaussians: Gaussians):
    opacities = torch.tensor([0.0, 0.3, 1.0, 1.0], requires_grad=True)
    Opacity(copies=1.5)(replace(gaussians, opacities=opacities)).sum().backward()
    assert opacities.grad is not None
    slope = 1.5 * (1 - opacities.detach()) ** 0.5
    assert torch.allclose(opacities.grad, slope)


@pytest.mark.parametrize("copies", [0.99, 1001.0, float("nan")])
def test_fewer_copies_than_one_are_refused(copies: float):
    with pytest.raises(ValueError, match="opacity: copies must be 1 to 1000, got"):
        Opacity(copies=copies)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_fixed_is_one_constant(gaussians: Gaussians, value: float):
    weight = Fixed(value)(gaussians)
    assert weight.tolist() == [value] * 4
    assert not weight.requires_grad


@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_fixed_outside_the_unit_interval_is_refused(value: float):
    with pytest.raises(ValueError, match=r"Fixed: value must be in \[0, 1\], got"):
        Fixed(value)


@pytest.mark.parametrize(
    ("option", "want"),
    [
        ("learned", Learned()),
        ("per_level", PerLevel()),
        ("opacity", Opacity()),
        ("fixed", Fixed(1.0)),
    ],
)
def test_option_is_the_default_of_its_class(option: str, want: object):
    assert instantiate(OmegaConf.load(CONF / f"{option}.yaml")) == want
