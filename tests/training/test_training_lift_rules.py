"""Every rule of lifting against a loop over pixels, whose weights come from the dense reference, in float64."""

from copy import copy
from dataclasses import replace

import pytest
import torch
from tiny_runs import composed
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.config import instantiate
from vlgs.fields.splat import SplatModel
from vlgs.fusion.none import NoFusion
from vlgs.gaussians import attributes_of
from vlgs.gaussians.config import GaussiansConfig
from vlgs.gaussians.init import initialise
from vlgs.heads.identity import Identity
from vlgs.indicator import Opacity
from vlgs.ops.pixel_weights import PixelWeights, pixel_weights
from vlgs.ops.project import project
from vlgs.ops.rasterize_reference import rasterize
from vlgs.training.lift_rules import Direction, LiftRule, Mean, Robust, Squared, TopK
from vlgs.training.mask_weights import Share, mask_weights, masked_views
from vlgs.types import ChannelGroup, RasterConfig, Scene

RULES = (Mean(), Squared(), TopK(3), Direction(), Robust(steps=6))


@pytest.fixture(scope="module")
def model(tiny_scene: Scene) -> SplatModel:
    """Some sparse points of the scene as Gaussians, so that glass and steel hide each other; one that no view sees."""
    config = GaussiansConfig(max_count=60)
    table = attributes_of(config, 5)
    params = initialise(tiny_scene, config, table)
    generator = torch.Generator().manual_seed(0)
    params["opacity_logits"] = 3 * torch.randn(60, generator=generator)
    params["means"][7] = torch.tensor([0.0, 0.0, 1e4])
    params = {name: value.double() for name, value in params.items()}
    return SplatModel(
        params, NoFusion(), Opacity(), Identity(5), RasterConfig(), 0, attributes=table
    )


def dense_weights(model: SplatModel, scene: Scene) -> list[Tensor]:
    """w_ip of every view, [pixels, n]: what the reference makes of one channel per Gaussian."""
    splats = model.gaussians()
    with torch.no_grad():
        group = ChannelGroup(torch.eye(model.count, dtype=torch.float64), splats.opacities)
        return [
            rasterize(splats.means, splats.quats, splats.scales, [group], view.camera, model.raster)
            .images[0].flatten(0, 1)
            for view in scene.train
        ]  # fmt: skip


def by_loop(rule: LiftRule, images: list[Tensor], masks: list[Tensor], vectors: Tensor) -> Tensor:
    """Codes of every Gaussian, pixel by pixel."""
    points: list[list[tuple[float, Tensor]]] = [[] for _ in range(images[0].shape[1])]
    for image, index in zip(images, masks, strict=True):
        for weights, mask in zip(image, index.flatten().tolist(), strict=True):
            order = weights.argsort(descending=True, stable=True).tolist()
            before, total = 0.0, float(weights.sum())
            order = order[: int((weights > 0).sum())]
            for rank, (i, w) in enumerate(zip(order, weights[order].tolist(), strict=True)):
                counts = mask >= 0
                if isinstance(rule, TopK):
                    counts &= rank < rule.k
                if isinstance(rule, Robust):
                    counts &= rank == 0 or (before < rule.mass * total and w >= rule.floor)
                before += w
                if counts:
                    points[i].append((w * w if isinstance(rule, Squared) else w, vectors[mask]))
    codes = torch.zeros(len(points), vectors.shape[1], dtype=torch.float64)
    for i, own in enumerate(points):
        if own:
            weight = torch.tensor([w for w, _ in own], dtype=torch.float64)[:, None]
            seen = torch.stack([h for _, h in own])
            codes[i] = (weight * seen).sum(0) / weight.sum()
            if isinstance(rule, Robust):
                for _ in range(rule.steps):
                    near = (codes[i] - seen).norm(dim=1, keepdim=True).clamp_min(1e-3)
                    codes[i] = (weight / near * seen).sum(0) / (weight / near).sum()
    unit = isinstance(rule, TopK | Direction | Robust)
    return normalize(codes, dim=1) if unit else codes


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_a_rule_is_the_loop_over_pixels(model: SplatModel, tiny_scene: Scene, rule: LiftRule):
    scene = replace(tiny_scene, train=tiny_scene.train[:2])
    vectors = normalize(torch.randn(len(scene.mask_vectors), 5, dtype=torch.float64), dim=1)
    masks = [view.index for view in masked_views(scene)]
    want = by_loop(rule, dense_weights(model, scene), masks, vectors)
    got = rule.combine(mask_weights(model, scene, share=rule.share), vectors)
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5)
    assert not got[7].any(), "what no view sees says nothing"
    assert (got.norm(dim=1) > 0).sum() > 25


@pytest.mark.parametrize("stop", ["after", "before"])
def test_pixel_weights_are_the_references(
    model: SplatModel, tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch, stop: str
):
    monkeypatch.setattr("vlgs.ops.pixel_weights.PIXELS", 48 * 7)  # parts of unequal height
    config = replace(model.raster, stop=stop, transmittance_min=0.3)  # type: ignore[arg-type]
    scene, splats = replace(tiny_scene, train=tiny_scene.train[:1]), model.gaussians()
    camera = scene.train[0].camera
    projected = project(splats.means, splats.quats, splats.scales, camera, config)
    monkeypatch.setattr(model, "raster", config)
    (want,) = dense_weights(model, scene)
    got, before = torch.zeros_like(want), -1
    for part in pixel_weights(projected, splats.opacities, camera, config):
        assert (part.weight > 0).all()
        assert (part.pixel.diff() >= 0).all()
        assert part.pixel[0] > before
        before = int(part.pixel[-1])
        got[part.pixel, part.gaussian] = part.weight
    torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-9)


def test_one_pixel_worked_by_hand():
    part = PixelWeights(torch.zeros(4).long(), torch.arange(4), torch.tensor([0.2, 0.5, 0.05, 0.2]))
    assert torch.equal(TopK(2).share(part), torch.tensor([0.2, 0.5, 0.0, 0.0]))
    # 0.5 and 0.2 of 0.95 are 74 %: the other 0.2 is seen too, 0.05 is not.
    assert torch.equal(Robust(0.75, 0.1).share(part), torch.tensor([0.2, 0.5, 0.0, 0.2]))
    assert torch.equal(Robust(0.7, 0.1).share(part), torch.tensor([0.2, 0.5, 0.0, 0.0]))
    assert torch.equal(Robust(0.75, 0.9).share(part), torch.tensor([0.0, 0.5, 0.0, 0.0]))
    assert torch.equal(Squared().share(part), part.weight**2)


@pytest.mark.parametrize("share", [None, Squared().share], ids=["backward", "one by one"])
def test_sampled_pixels_weigh_what_they_weigh_among_all(
    model: SplatModel, tiny_scene: Scene, share: Share | None
):
    model = copy(model)
    model.raster = replace(model.raster, fov_margin=1e6)  # what is clamped depends on the image
    width, height = tiny_scene.train[0].camera.width, tiny_scene.train[0].camera.height
    pixels = -(-width // 3) * -(-height // 3)
    views = list(masked_views(tiny_scene, pixels=pixels))
    assert all(view.step == 3 and view.index.numel() <= pixels for view in views)
    got = mask_weights(model, tiny_scene, share=share, pixels=pixels)
    want = torch.zeros(model.count, len(tiny_scene.mask_vectors), dtype=torch.float64)
    for weights, view, whole in zip(
        dense_weights(model, tiny_scene), views, masked_views(tiny_scene), strict=True
    ):
        assert torch.equal(view.index, whole.index[::3, ::3])
        weights = weights.unflatten(0, (height, width))[::3, ::3][view.index >= 0]
        weights = weights if share is None else weights.square()
        want.index_add_(1, view.index[view.index >= 0].long(), weights.T.contiguous())
    found = torch.zeros_like(want)
    found[got.gaussian, got.mask] = got.weight
    torch.testing.assert_close(found, want, rtol=1e-5, atol=1e-5)
    assert torch.equal(mask_weights(model, tiny_scene, share=share, pixels=width * height).weight, mask_weights(model, tiny_scene, share=share).weight)  # fmt: skip


def test_each_level_is_lifted_from_its_own_masks(model: SplatModel, tiny_scene: Scene):
    scene = replace(tiny_scene, train=tiny_scene.train[:2])
    views = [
        replace(
            view,
            read_masks=lambda index=masked.index: torch.stack([index.flip(0), index], dim=-1),
        )
        for view, masked in zip(scene.train, masked_views(scene), strict=True)
    ]
    joint = replace(scene, train=tuple(views), mask_levels=2)
    alone, second = mask_weights(model, scene), mask_weights(model, joint, level=1)
    assert torch.equal(alone.mask, second.mask)
    assert torch.equal(alone.weight, second.weight)
    assert not torch.equal(alone.weight, mask_weights(model, joint, level=0).weight)


def test_options_are_the_defaults_and_go_with_the_method_alone():
    for name, rule in {"mean": Mean(), "top_k": TopK(), "robust": Robust()}.items():
        config = composed("method=lift", f"lift={name}")
        assert instantiate(config.lift) == rule
        assert instantiate(config.stages[1]).lift == rule
    assert "lift" not in composed()
    with pytest.raises(ValueError, match="top_k: k must be 1 to"):
        TopK(0)
    with pytest.raises(ValueError, match=r"robust: mass must be 0 to 1, got 1\.5"):
        Robust(mass=1.5)
