"""Depth of every kind of field: camera z, whatever the field is made of."""

from dataclasses import replace
from typing import get_args

import pytest
import torch
from test_fields_cloud import model_of
from test_fields_nerf import CAMERA, language, radiance
from torch import nn

from vlgs.fields import Field, HasDepth, depth_of
from vlgs.fields.hash_splat import HashSplatField
from vlgs.fields.nerf import NerfField
from vlgs.fields.planes import with_planes
from vlgs.fields.several import SeveralFields
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import SplatField
from vlgs.fusion.none import NoFusion
from vlgs.geometry import quat_to_rotmat
from vlgs.ops.depth import render_depth
from vlgs.types import Camera, DepthKind

KINDS: tuple[DepthKind, ...] = get_args(DepthKind)
VIEWMAT = torch.eye(4)
VIEWMAT[2, 3] = 4.0
VIEW = Camera(VIEWMAT, torch.tensor([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]), 16, 12)
WIDE = {"opacity_logits": torch.full((30,), 2.0), "log_scales": torch.zeros(30, 3)}


def solid(**changed: torch.Tensor) -> SplatModel:
    model = model_of(NoFusion())
    for name, value in {**WIDE, **changed}.items():
        model.splats[name] = nn.Parameter(value)
    return model


def drawn(model: SplatModel, weight: str, kind: DepthKind) -> torch.Tensor:
    p = model.splats
    size = VIEW.viewmat, VIEW.K, VIEW.width, VIEW.height
    with torch.no_grad():
        return render_depth(
            p["means"], p["quats"], p["log_scales"].exp(), p[weight].sigmoid(), *size, kind=kind
        )


@pytest.mark.parametrize("kind", KINDS)
def test_gaussians_are_as_far_as_their_opacity_says_or_their_language(kind: DepthKind):
    model = solid(indicator_logits=torch.linspace(-3, 3, 30))
    want = drawn(model, "opacity_logits", kind)
    assert want.any()
    field = SplatField(model)
    torch.testing.assert_close(field.depth(VIEW, kind), want)
    torch.testing.assert_close(SplatField(model, language=False).depth(VIEW, kind), want)
    torch.testing.assert_close(
        HashSplatField(field, language(), radiance().frame).depth(VIEW, kind), want
    )
    colorless = SplatField(model, color=False).depth(VIEW, kind)
    torch.testing.assert_close(colorless, drawn(model, "indicator_logits", kind))


def test_language_has_the_depth_of_its_own_shapes_where_there_is_no_colour():
    shapes = {
        "language_quats": torch.randn(30, 4),
        "language_log_scales": torch.full((30, 3), -1.0),
    }
    model = solid(**shapes)
    model.splats["indicator_logits"] = nn.Parameter(torch.ones(30))
    plain = SplatField(solid(indicator_logits=torch.ones(30)), color=False).depth(VIEW)
    assert not torch.equal(SplatField(model, color=False).depth(VIEW), plain)
    torch.testing.assert_close(
        SplatField(model).depth(VIEW), drawn(model, "opacity_logits", "expected")
    )


def test_several_fields_and_planes_are_as_far_as_what_they_are_made_of():
    fields = [SplatField(solid()), SplatField(solid(means=torch.ones(30, 3)))]
    want = fields[0].depth(VIEW, "median")
    assert torch.equal(SeveralFields(fields).depth(VIEW, "median"), want)
    planes = with_planes(fields[0], torch.zeros(0, 3), [])
    assert torch.equal(depth_of(planes, VIEW, "median"), want)
    for field in (*fields, SeveralFields(fields), planes, NerfField(radiance())):
        assert isinstance(field, HasDepth)


def test_a_field_without_distances_is_named():
    class Flat:
        outputs, has_language = frozenset({"color"}), False
        levels = render = similarity = lambda *_: None

    flat: Field = Flat()  # type: ignore[assignment]
    for field in (flat, SeveralFields([flat]), with_planes(flat, torch.zeros(0, 3), [])):
        with pytest.raises(ValueError, match=r"depth: the field must know distances .* got Flat"):
            depth_of(field, VIEW)


@pytest.mark.parametrize("kind", KINDS)
def test_rays_are_as_far_as_their_samples_along_the_axis_of_the_camera(kind: DepthKind):
    field = radiance()
    field.frame = replace(field.frame, scale=0.5, center=torch.tensor([0.1, 0.2, 0.3]))
    viewmat = torch.eye(4)
    viewmat[:3, :3] = quat_to_rotmat(torch.tensor([0.9, 0.1, -0.3, 0.2]))
    viewmat[:3, 3] = torch.tensor([0.5, -0.2, 1.0])
    camera = Camera(viewmat, CAMERA.K, CAMERA.width, CAMERA.height)
    got = NerfField(field, language(scaled=False)).depth(camera, kind).flatten()

    rays = field.frame.look(camera, torch.arange(48))
    samples = field.sample(rays)
    weights = field.weights(samples).detach()
    points = rays.points(samples.distances) / 0.5 + field.frame.center
    z = points @ viewmat[2, :3] + viewmat[2, 3]
    for pixel in range(48):
        seen, total = 0.0, 0.0
        for w, depth in zip(weights[pixel].tolist(), z[pixel].tolist(), strict=True):
            seen, total = seen + w, total + w * depth
            if kind == "median" and seen >= 0.5:
                total = depth
                break
        want = total / seen if kind == "expected" else total
        assert got[pixel].item() == pytest.approx(want, rel=1e-3)
