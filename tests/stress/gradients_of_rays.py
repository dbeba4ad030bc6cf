"""Radiance fields on rays and their hash grids, as functions of places, weights and features."""

from collections.abc import Callable
from typing import get_args

import torch
from torch import Tensor

from tests.stress.draws import Check, draw
from vlgs.fields.hash_grid import GridConfig, HashGrid, contract, interpolate
from vlgs.fields.language_field import LanguageConfig, LanguageField
from vlgs.fields.nerf import along
from vlgs.fields.radiance import Frame, RadianceConfig, RadianceField, Samples, harmonics, in_cube
from vlgs.fields.rays import Rays, Spacing, ray_depth, ray_weights, spread
from vlgs.types import DepthKind

GRID = GridConfig(levels=2, features=2, coarsest=2, finest=4, log2_table=5)
PLACES = draw(3, 3, seed=7, low=0.1, high=0.9)
RAYS = Rays(draw(2, 3, seed=8), torch.nn.functional.normalize(draw(2, 3, seed=9), dim=1))


def by_table(function: Callable[[HashGrid], Tensor]) -> Check:
    """By all features of a hash grid."""
    grid = HashGrid(GRID).double()
    return by_parameters(grid, lambda: function(grid))


def radiance() -> RadianceField:
    frame = Frame(torch.zeros(3).double(), 1.0, Spacing(0.1, 2.0), torch.zeros(0, 3))
    config = RadianceConfig(GRID, width=3, coarse=4, samples=3, cells=4)
    return RadianceField(config, frame, torch.Generator().manual_seed(0)).double()


def by_radiance(function: Callable[[RadianceField, Samples], object]) -> Check:
    field = radiance()
    samples = field.sample(RAYS)
    return by_parameters(field, lambda: function(field, samples))


def by_language(function: Callable[[LanguageField, Tensor], Tensor]) -> Check:
    config = LanguageConfig([GRID], hidden=1, width=3, half=False)
    field = LanguageField(config, 4, 2, torch.Generator().manual_seed(0)).double()
    return by_parameters(field, lambda: function(field, draw(3, GRID.width)))


def by_parameters(module: torch.nn.Module, function: Callable[[], object]) -> Check:
    """By all weights of a module; draws of size 1 in place of its initial ones, which are near a kink of ReLU."""
    names = [name for name, _ in module.named_parameters()]
    values = [draw(*p.shape, seed=i) for i, p in enumerate(module.parameters())]

    class Called(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = module

        def forward(self) -> object:
            return function()

    def call(*given: Tensor) -> object:
        state = {f"inner.{name}": value for name, value in zip(names, given, strict=True)}
        return torch.func.functional_call(Called(), state, ())

    return call, values


RAY_CHECKS: dict[str, Callable[[], Check]] = {
    "vlgs.fields.hash_grid.contract": lambda: (contract, [draw(3, 3, low=-0.5, high=0.5)]),
    "vlgs.fields.hash_grid.contract beyond 1": lambda: (contract, [3 + draw(3, 3)]),
    "vlgs.fields.hash_grid.interpolate": lambda: (
        lambda t: interpolate(t, *HashGrid(GRID).double().corners(PLACES)), [draw(HashGrid(GRID).table.shape[0], 2)]
    ),
    "vlgs.fields.hash_grid.HashGrid.forward": lambda: by_table(lambda grid: grid(PLACES)),
    "vlgs.fields.rays.Rays.points": lambda: (lambda o, d, t: Rays(o, d).points(t), [draw(2, 3), draw(2, 3, seed=1), draw(2, 4)]),
    **{
        f"vlgs.fields.rays.ray_depth, {kind}": lambda kind=kind: (
            lambda d, w: ray_depth(d, w, kind), [draw(3, 4, low=1, high=2), draw(3, 4, seed=1, low=0.1)]
        )
        for kind in get_args(DepthKind)
    },
    "vlgs.fields.rays.ray_weights": lambda: (ray_weights, [draw(3, 4, low=0.1), draw(3, 4, seed=1, low=0.1)]),
    "vlgs.fields.rays.spread": lambda: (
        lambda w: spread(draw(3, 5).sort(dim=1).values, w), [draw(3, 4, seed=1, low=0.1)]
    ),
    "vlgs.fields.radiance.in_cube": lambda: (in_cube, [draw(3, 3, low=-0.5, high=0.5)]),
    "vlgs.fields.radiance.harmonics": lambda: (harmonics, [draw(3, 3)]),
    "vlgs.fields.radiance.RadianceField.density": lambda: by_radiance(lambda f, s: f.density(s.places.flatten(0, 1))),
    "vlgs.fields.radiance.RadianceField.weights": lambda: by_radiance(lambda f, s: f.weights(s)),
    "vlgs.fields.radiance.RadianceField.forward": lambda: by_radiance(lambda f, s: f(RAYS, s)),
    "vlgs.fields.language_field.LanguageField.features": lambda: by_language(lambda f, _: f.features(PLACES)),
    "vlgs.fields.language_field.LanguageField.embed": lambda: by_language(lambda f, x: f.embed(x, 0.3)),
    "vlgs.fields.language_field.LanguageField.low": lambda: by_language(lambda f, x: f.low(x)),
    "vlgs.fields.nerf.along": lambda: by_language(
        lambda f, _: along(f, radiance().sample(RAYS), draw(2, 3, low=0.1), 2)[0]
    ),
}  # fmt: skip
