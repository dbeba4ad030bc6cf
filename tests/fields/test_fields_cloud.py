"""A model as plain Gaussians: what is written for other programs."""

import pytest
import torch
from torch import Tensor, nn

from vlgs.fields.cloud import HIGHEST_LOGIT, point_cloud
from vlgs.fields.splat import SplatModel
from vlgs.fusion import Fusion
from vlgs.fusion.attention import CrossAttention
from vlgs.fusion.mlp import MLP
from vlgs.fusion.none import NoFusion
from vlgs.gaussians import view_color
from vlgs.geometry import camera_center
from vlgs.heads.identity import Identity
from vlgs.indicator import Fixed, Indicator, Learned, Opacity
from vlgs.types import Camera, RasterConfig

N = 30
LEARNED = Learned()


def cameras(count: int) -> list[Camera]:
    """Around the origin, looking anywhere."""
    generator = torch.Generator().manual_seed(1)
    found = []
    for eye in 4 * nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = -eye
        K = torch.tensor([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]])
        found.append(Camera(viewmat, K, 16, 12))
    return found


def model_of(
    fusion: Fusion, indicator: Indicator = LEARNED, degree: int = 3, evaluated: bool = False
) -> SplatModel:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    params = {
        "means": draw(N, 3), "quats": draw(N, 4), "log_scales": draw(N, 3) - 2, "sh0": draw(N, 3),
        "shN": 0.3 * draw(N, 15, 3), "opacity_logits": draw(N), "indicator_logits": draw(N), "features": draw(N, 3),
    }  # fmt: skip
    return SplatModel(params, fusion, indicator, Identity(3), RasterConfig(), degree, evaluated)


def moved(fusion: nn.Module) -> nn.Module:
    """Weights as after training."""
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in fusion.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
    return fusion


def seen(params: dict[str, Tensor], camera: Camera) -> Tensor:
    """Colour of every Gaussian as a 3DGS viewer forms it."""
    rgb = 0.5 + 0.28209479177387814 * params["sh0"]
    return view_color(rgb, params["shN"], params["means"], camera_center(camera.viewmat), 3)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("fusion", [NoFusion(), moved(MLP(3, 3)), moved(CrossAttention(3, 3))])
def test_colour_is_that_of_the_model_and_what_has_not_joined_is_left_out(
    fusion: Fusion, degree: int
):
    model = model_of(fusion, degree=degree)
    cloud = point_cloud(model, [])
    with torch.no_grad():
        fused = model.fuse()
        for camera in cameras(3):
            color = model.view_color(fused, camera)
            torch.testing.assert_close(seen(cloud.params, camera), color, rtol=0, atol=2e-6)
    assert not cloud.params["shN"][:, (degree + 1) ** 2 - 1 :].any()
    torch.testing.assert_close(cloud.params["features"], fused.feature)


def test_without_fusion_every_bit_stays():
    model = model_of(NoFusion())
    cloud = point_cloud(model, [])
    assert all(torch.equal(cloud.params[name], model.splats[name]) for name in model.splats)
    for name, value in cloud.params.items():
        value.zero_()
        assert model.splats[name].any(), f"{name} must not share memory with the model"


@pytest.mark.parametrize(
    ("indicator", "expected"),
    [
        (Learned(), "indicator_logits"),
        (Opacity(), "opacity_logits"),
        (Fixed(0.25), torch.tensor(0.25).logit()),
        (Fixed(1.0), torch.tensor(HIGHEST_LOGIT)),
    ],
)
def test_the_indicator_is_what_blends_language(indicator: Indicator, expected: str | Tensor):
    model = model_of(NoFusion(), indicator)
    written = point_cloud(model, []).params["indicator_logits"]
    wanted = model.splats[expected] if isinstance(expected, str) else expected.expand(N)
    torch.testing.assert_close(
        written, wanted.detach(), rtol=0, atol=0 if isinstance(expected, str) else 1e-6
    )


def test_a_model_of_language_alone_shows_its_shapes():
    model = model_of(NoFusion())
    cloud = point_cloud(model, [], color=False)
    assert torch.equal(cloud.params["opacity_logits"], model.splats["indicator_logits"])
    assert "trained for language alone" in cloud.notes[1]


@pytest.mark.parametrize("fusion", [NoFusion(), moved(CrossAttention(3, 3))])
def test_colour_that_fusion_leaves_alone_is_exact_where_fusion_sees_each_view(fusion: Fusion):
    model = model_of(fusion, evaluated=True)
    cloud = point_cloud(model, cameras(20))
    with torch.no_grad():
        fused = model.fuse()
        for camera in cameras(30):
            color = model.view_color(fused, camera)
            torch.testing.assert_close(seen(cloud.params, camera), color, rtol=0, atol=1e-5)
    assert "off by 0.00000 rms" in cloud.notes[1]


def test_harmonics_are_fitted_where_fusion_sees_each_view():
    model = model_of(moved(MLP(3, 3)), evaluated=True)
    views = cameras(40)
    cloud = point_cloud(model, views)
    with torch.no_grad():
        fused = model.fuse()
        gaps = [model.view_color(fused, c) - seen(cloud.params, c) for c in views]
        raw = [model.view_color(fused, c) - seen(dict(model.splats), c) for c in views]
    error, unfitted = (torch.stack(g).square().mean().sqrt().item() for g in (gaps, raw))
    assert error < unfitted / 5
    told = float(cloud.notes[1].split("off by ")[1].split()[0])
    assert told >= error - 1e-5, "renderers clamp at 0, which never makes a fit worse"
    assert told < error * 2


def test_at_degree_0_the_fit_is_exact():
    model = model_of(moved(MLP(3, 3)), degree=0, evaluated=True)
    cloud = point_cloud(model, cameras(4))
    camera = cameras(5)[-1]
    with torch.no_grad():
        color = model.view_color(model.fuse(), camera)
    torch.testing.assert_close(seen(cloud.params, camera), color, rtol=0, atol=2e-5)
