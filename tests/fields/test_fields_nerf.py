"""A field of rays: what it renders, and LERF's search over scales against a loop."""

import pytest
import torch
from torch.nn.functional import normalize

from vlgs.fields import Field, gaussians_of
from vlgs.fields.hash_grid import GridConfig
from vlgs.fields.language_field import LanguageConfig, LanguageField
from vlgs.fields.nerf import NerfField, along
from vlgs.fields.radiance import Frame, RadianceConfig, RadianceField, Samples
from vlgs.fields.rays import Rays, Spacing, pixel_rays
from vlgs.queries.relevancy import LerfRelevancy
from vlgs.types import Camera

GRID = GridConfig(2, 2, 4, 8, 8)
CONFIG = RadianceConfig(GRID, width=8, coarse=8, samples=6, cells=8)
CAMERA = Camera(torch.eye(4), torch.tensor([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]), 8, 6)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def radiance() -> RadianceField:
    return RadianceField(
        CONFIG, Frame(torch.zeros(3), 1.0, Spacing(0.1, 2.0), torch.zeros(0, 3)), generator()
    )


def language(scaled: bool = True) -> LanguageField:
    config = LanguageConfig([GRID], hidden=1, width=16, scaled=scaled, half=False)
    made = LanguageField(config, 5, generator=generator(1))
    with torch.no_grad():
        made.grids[0].table.mul_(1e4)  # type: ignore[operator]
    return made


def test_it_is_a_field_without_gaussians():
    field = NerfField(radiance(), language(), scales=[0.1])
    assert isinstance(field, Field)
    assert gaussians_of(field) is None
    assert list(field.levels()) == [field]
    seen = field.render(CAMERA, frozenset({"color", "alpha", "feature"}))
    assert seen.color is not None
    assert seen.color.shape == (6, 8, 3)
    assert seen.feature is not None
    assert seen.feature.shape == (1, 6, 8, GRID.width)
    assert NerfField(radiance()).outputs == {"color", "alpha"}
    with pytest.raises(
        ValueError, match="radiance field: outputs must be some of alpha, color, feat"
    ):
        field.render(CAMERA, frozenset({"depth"}))


def test_what_is_rendered_is_the_sum_over_a_ray():
    field, rays = radiance(), pixel_rays(CAMERA, torch.arange(48))
    samples = field.sample(rays)
    color, weights, density = field(rays, samples)
    torch.testing.assert_close(weights.sum(1), torch.ones(48))  # the last interval has no end
    passed = torch.ones(48)
    for i in range(CONFIG.samples):
        alpha = 1 - torch.exp(-density[:, i] * samples.lengths[:, i])
        torch.testing.assert_close(weights[:, i], alpha * passed, rtol=1e-4, atol=1e-6)
        passed = passed * (1 - alpha)
    got = NerfField(field).render(CAMERA, frozenset({"color"})).color
    torch.testing.assert_close(got, color.view(6, 8, 3))


def test_samples_lie_where_something_was():
    field = radiance()
    places = torch.full((1, 1, 3), 0.5) + torch.tensor([0, 0, 0.3 / 4])  # 0.3 before the middle
    lengths = torch.ones(1, 1)
    field.keep(Samples(lengths, lengths, lengths, places), torch.full((1, 1), 1e4))
    ray = Rays(torch.tensor([[0.0, 0, -1]]), torch.tensor([[0.0, 0, 1]]))
    distances = field.sample(ray).distances[0]
    assert ((distances > 0.9) & (distances < 2.1)).sum() >= 3


def test_features_of_a_ray_are_those_of_its_heaviest_samples():
    field, rays = radiance(), pixel_rays(CAMERA, torch.arange(48))
    samples = field.sample(rays)
    weights = torch.rand(48, CONFIG.samples, generator=generator())
    weights.requires_grad_()
    said = language()
    features, distance = along(said, samples, weights, 2)
    best = weights[7].argsort(descending=True)[:2]
    share = weights[7, best] / weights[7, best].sum()
    want = share @ said.features(samples.places[7, best])
    torch.testing.assert_close(features[7], want)
    torch.testing.assert_close(distance[7], share @ samples.distances[7, best])
    features.sum().backward()
    assert weights.grad is None, "language must not move the radiance field"


def test_each_word_has_the_scale_of_its_highest_relevancy():
    scales, query = [0.0, 0.5, 1.5, 3.0], LerfRelevancy()
    words = normalize(torch.randn(12, 5, generator=generator(2)), dim=1)
    negatives = normalize(torch.randn(4, 5, generator=generator(3)), dim=1)
    field = NerfField(radiance(), language(), scales=scales, negatives=negatives)
    found = field.similarity(CAMERA, torch.cat([words, negatives]))[0]
    got = query.relevancy(found[:12], found[12:])
    features = field.render(CAMERA, frozenset({"feature"})).feature
    assert features is not None
    chosen = []
    for word, relevancy in zip(words, got, strict=True):
        best, at = torch.zeros(6, 8), None
        for scale in scales:
            said = language().embed(features[0].flatten(0, 1), scale)
            seen = query(said, word[None], negatives)[0].view(6, 8)
            if seen.max() > best.max():
                best, at = seen, scale
        chosen.append(at)
        torch.testing.assert_close(relevancy, best, rtol=1e-4, atol=1e-5)
    assert len(set(chosen)) > 1, "the example should tell scales apart"
    fixed = NerfField(radiance(), language(), scales=[0.5]).similarity(CAMERA, words)[0]
    said = language().embed(features[0].flatten(0, 1), 0.5)
    torch.testing.assert_close(fixed.flatten(1), words @ said.T, rtol=1e-4, atol=1e-5)


def test_pixels_that_are_asked_alone_have_the_same_answer_at_one_scale():
    field = NerfField(radiance(), language(scaled=False))
    words, pixels = torch.eye(5)[:2], torch.tensor([3, 17, 40])
    whole = field.similarity(CAMERA, words)
    part = field.similarity(CAMERA, words, pixels=pixels)
    torch.testing.assert_close(part[:, :, 0], whole.flatten(2)[:, :, pixels])
