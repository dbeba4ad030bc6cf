"""A radiance field: density and colour of every point of space, from a hash grid and two small networks."""

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import max_pool3d

from vlgs.fields.hash_grid import GridConfig, HashGrid, contract
from vlgs.fields.rays import Rays, Spacing, importance, nearest_seen, pixel_rays, ray_weights
from vlgs.heads.rows import layers
from vlgs.types import Camera
from vlgs.values import require_fields, require_range

_GEOMETRY = 15
"""Numbers that the density's network hands to that of colour."""
_DIRECTION = 16
"""Harmonics of the direction of view, degrees 0 to 3."""
_THICKEST = 5.0
"""A cell of the kept densities counts as no denser: a ray may pass what fills only a part of it, and must find what lies behind."""
_MARGIN = 0.85
"""Of the distance of the nearest sparse point."""
_FOG = 4.0
"""Space begins with a density of exp(-4) to the unit: an even fog of more hides from all cameras what they should agree on."""
_HIGHEST = 12.0
"""Logarithm of the largest density."""
_DOUBT, _EXPECTED = 0.05, 30.0
"""Densities that are kept at first, of anywhere and of the cells around sparse points."""


@dataclass(frozen=True)
class RadianceConfig:
    """What a radiance field is made of.

    Raises:
        ValueError: If a number is out of range.
    """

    grid: GridConfig = field(default_factory=lambda: GridConfig(8, 2, 16, 1024, 17))
    width: int = 64
    """Of the hidden layers, one of density and two of colour."""
    coarse: int = 96
    """Steps along a ray at which the kept densities are looked up."""
    samples: int = 24
    """Places along a ray at which the networks are asked."""
    cells: int = 96
    """Along each axis of the kept densities."""

    def __post_init__(self) -> None:
        require_fields("radiance field", self)
        require_range("radiance field", 1, 1024, width=self.width, samples=self.samples)
        require_range("radiance field", 2, 4096, coarse=self.coarse)
        require_range("radiance field", 2, 512, cells=self.cells)


@dataclass(frozen=True)
class Frame:
    """The part of space that matters, which becomes the unit ball, and where rays begin."""

    center: Float[Tensor, "3"]
    scale: float
    """World units times this are those of the ball."""
    spacing: Spacing
    """In units of the ball."""
    points: Float[Tensor, "p 3"]
    """On surfaces, in world units: nothing is looked for much nearer to a camera than those that it sees; may be empty."""

    def inside(self, rays: Rays) -> Rays:
        """Rays of the world in units of the ball."""
        near = None if rays.near is None else rays.near * self.scale
        return Rays((rays.origins - self.center) * self.scale, rays.directions, near)

    def look(self, camera: Camera, pixels: Int[Tensor, " r"]) -> Rays:
        """Rays through pixels of a camera, counted row by row, in units of the ball."""
        rays = pixel_rays(camera, pixels)
        near = nearest_of(nearest_seen(camera, self.points), camera.width, camera.height, pixels)
        return self.inside(replace(rays, near=near))


@dataclass(frozen=True)
class Samples:
    """Intervals along rays, each known at one place."""

    edges: Float[Tensor, "r c"]
    """Bounds of the intervals, as steps in [0, 1] of `Spacing`."""
    distances: Float[Tensor, "r s"]
    """Of the places."""
    lengths: Float[Tensor, "r s"]
    """Of the intervals; the last one has no end."""
    places: Float[Tensor, "r s 3"]
    """In the unit cube that all of space is contracted to."""


class RadianceField(nn.Module):
    """Density and colour of every point, rendered along rays.

    Where a ray is sampled is drawn by densities that are kept in a coarse grid, as they were when training last came by; a small
    share is even, so that nothing is never looked at again. Space is contracted (`contract`), so that the field has no end: what lies behind
    everything is opaque.

    Args:
        config: What it is made of.
        frame: What becomes the unit ball.
        generator: Draws the weights of the start.
    """

    def __init__(
        self, config: RadianceConfig, frame: Frame, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        self.config = config
        self.frame = frame
        self.grid = HashGrid(config.grid, generator)
        width = config.width
        self.density_net = mlp([config.grid.width, width, 1 + _GEOMETRY], generator)
        self.color_net = mlp([_GEOMETRY + _DIRECTION, width, width, 3], generator)
        self.kept: Tensor
        self.register_buffer("kept", torch.full([config.cells**3], _DOUBT))

    def sample(self, rays: Rays, generator: torch.Generator | None = None) -> Samples:
        """Intervals along rays of the ball, short where something is.

        Args:
            rays: In units of the ball.
            generator: Moves them at random, for training; None: they are where they always are.
        """
        config, spacing = self.config, self.frame.spacing
        r = len(rays.origins)
        edges = torch.linspace(0, 1, config.coarse + 1).expand(r, -1)
        if generator is not None:
            shift = torch.rand(r, 1, generator=generator) - 0.5
            edges = torch.cat(
                [edges[:, :1], edges[:, 1:-1] + shift / config.coarse, edges[:, -1:]], -1
            )
        near = None if rays.near is None else rays.near[:, None]
        far = spacing(edges, near)
        middles = (far[:, 1:] + far[:, :-1]) / 2
        density = self.kept[self._cells(in_cube(rays.points(middles)).flatten(0, 1))].view(r, -1)
        weights = ray_weights(density.clamp_max(_THICKEST), far.diff(dim=-1))
        weights = weights + 0.05 * weights.sum(-1, keepdim=True) / config.coarse + 1e-5
        draws = torch.linspace(0, 1, config.samples + 1).expand(r, -1)
        if generator is not None:
            shift = torch.rand(r, config.samples + 1, generator=generator) - 0.5
            draws = (draws + shift / config.samples).clamp(0, 1)
        edges = importance(edges, weights, draws)
        far = spacing(edges, near)
        middles = (far[:, 1:] + far[:, :-1]) / 2
        lengths = far.diff(dim=-1)
        lengths = torch.cat([lengths[:, :-1], torch.full_like(lengths[:, :1], 1e10)], dim=-1)
        return Samples(edges, middles, lengths, in_cube(rays.points(middles)))

    def density(
        self, places: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n g"]]:
        """Density at places of the cube, per unit of the ball, and what the colour's network is told of them."""
        out = layers(self.density_net, self.grid(places))
        return torch.exp((out[:, 0] - _FOG).clamp_max(_HIGHEST)), out[:, 1:]

    def weights(self, samples: Samples) -> Float[Tensor, "r s"]:
        """What each interval has of the light of a ray, without colour."""
        density, _ = self.density(samples.places.flatten(0, 1))
        return ray_weights(density.view_as(samples.distances), samples.lengths)

    def forward(
        self, rays: Rays, samples: Samples
    ) -> tuple[Float[Tensor, "r 3"], Float[Tensor, "r s"], Float[Tensor, "r s"]]:
        """Colour of rays, what each interval has of it, and the densities."""
        density, geometry = self.density(samples.places.flatten(0, 1))
        density = density.view_as(samples.distances)
        weights = ray_weights(density, samples.lengths)
        directions = harmonics(rays.directions)[:, None].expand(*density.shape, -1).flatten(0, 1)
        color = layers(self.color_net, torch.cat([geometry, directions], dim=-1)).sigmoid()
        return (weights[..., None] * color.view(*density.shape, 3)).sum(dim=1), weights, density

    @torch.no_grad()
    def keep(self, samples: Samples, density: Float[Tensor, "r s"]) -> None:
        """Remember densities for `sample`: those seen now, or what was there before, which fades."""
        cells = self._cells(samples.places.flatten(0, 1))
        seen = torch.zeros_like(self.kept).scatter_reduce_(
            0, cells.long(), density.flatten(), "amax"
        )
        fading = torch.maximum(0.9 * self.kept, seen)
        self.kept = torch.where(seen > 0, fading, self.kept)

    @torch.no_grad()
    def expect(self, points: Float[Tensor, "p 3"]) -> None:
        """Look closely around points of the ball at first: something is there."""
        n = self.config.cells
        there = torch.zeros_like(self.kept)
        there[self._cells(in_cube(points))] = _EXPECTED
        around = max_pool3d(there.view(1, n, n, n), kernel_size=3, stride=1, padding=1).flatten()
        self.kept = torch.maximum(self.kept, around)

    def _cells(self, places: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
        n = self.config.cells
        x, y, z = (places * n).int().clamp(0, n - 1).unbind(-1)
        return (z * n + y) * n + x


def nearest_of(
    seen: Float[Tensor, "*r c c"],
    width: int | Tensor,
    height: int | Tensor,
    pixels: Int[Tensor, " r"],
) -> Float[Tensor, " r"]:
    """What `nearest_seen` says of pixels, with a margin."""
    cells = seen.shape[-1]
    x, y = (pixels % width) * cells // width, (pixels // width) * cells // height
    at = y * cells + x
    flat = seen.flatten(-2)
    return _MARGIN * (flat[at] if flat.dim() == 1 else flat.gather(1, at[:, None])[:, 0])


def mlp(widths: list[int], generator: torch.Generator | None = None) -> nn.Sequential:
    """Linear layers with ReLU between them, with He's initial weights and no bias at first."""
    parts: list[nn.Module] = []
    for inner, outer in pairwise(widths):
        layer = nn.Linear(inner, outer)
        with torch.no_grad():
            layer.weight.copy_(
                torch.randn(outer, inner, generator=generator) * math.sqrt(2 / inner)
            )
            layer.bias.zero_()
        parts += [layer, nn.ReLU()]
    return nn.Sequential(*parts[:-1])


def harmonics(directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 16"]:
    """Polynomials of unit directions that span the spherical harmonics of degrees 0 to 3, each of size 1 or so."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.ones_like(x), x, y, z,
            x * y, y * z, x * z, xx - yy, 3 * zz - 1,
            x * (xx - 3 * yy), y * (3 * xx - yy), z * (xx - yy), x * y * z,
            x * (5 * zz - 1), y * (5 * zz - 1), z * (5 * zz - 3),
        ],
        dim=-1,
    )  # fmt: skip


def in_cube(points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Points of the ball and around it, contracted, in the unit cube."""
    return (contract(points) + 2) / 4
