"""Intersection of rays with all things of a scene: the first hit, its colour and normal, and how much light of the lamp arrives there."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from vlgs.data.synthetic.lights import Light
from vlgs.data.synthetic.objects import Part, Thing
from vlgs.data.synthetic.room import FLOOR, LAMP, ROOM, TABLE_RADIUS
from vlgs.data.synthetic.shapes import Box, Revolution, Vectors
from vlgs.types import IGNORE_ID

NOTHING = 255
"""Part number of a ray that hits nothing; does not happen from inside the room."""

_NEAR_BLOCK = 2048
"""Rays whose distances to all parts stay in the cache."""
_SHADOW_CELLS = 192
_LIFT = 1e-4  # a shadow ray starts this far above its surface, in metres
_HAIR = 1e-6  # distances above it are no matter of rounding, in metres
_GLASS_PASSES = 0.7  # share of the light that one piece of glass lets through


@dataclass(frozen=True)
class Hits:
    """First surface along each ray."""

    t: Float[np.ndarray, " n"]
    part: UInt8[np.ndarray, " n"]
    face: UInt8[np.ndarray, " n"]


@dataclass(frozen=True)
class Shade:
    """Share of the lamp that reaches a square of a horizontal plane, on a grid."""

    half: float
    grid: Float[np.ndarray, "g g"]

    def at(self, point: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
        """Bilinear lookup by x and y."""
        cells = self.grid.shape[0]
        scaled = (point[:2] / (2 * self.half) + 0.5) * (cells - 1)
        x, y = np.clip(scaled, 0, cells - 1.001)
        i, j = x.astype(np.intp), y.astype(np.intp)
        x, y = x - i, y - j
        near = self.grid[i, j] * (1 - y) + self.grid[i, j + 1] * y
        far = self.grid[i + 1, j] * (1 - y) + self.grid[i + 1, j + 1] * y
        return near * (1 - x) + far * x


class World:
    """Things with everything precomputed that a ray needs to know about them."""

    def __init__(self, things: tuple[Thing, ...], light: Light = LAMP):
        self.things = things
        self.light = light
        self.parts: tuple[Part, ...] = tuple(part for thing in things for part in thing.parts)
        self.thing_of_part = np.repeat(np.arange(len(things)), [len(t.parts) for t in things])
        masked = [thing.name for thing in things if thing.masked]
        self.classes: tuple[str, ...] = tuple(dict.fromkeys(masked))
        classes = [self.classes.index(t.name) if t.masked else IGNORE_ID for t in things]
        self.class_of_part = np.array(classes, np.uint8)[self.thing_of_part]
        self._rotations = [np.array(part.rotation) for part in self.parts]
        self._centers = [np.array(part.center)[:, None] for part in self.parts]
        bounds = [part.shape.bound() for part in self.parts]
        heights = np.array([height for height, _ in bounds])
        axes = np.stack([rotation[:, 2] for rotation in self._rotations])
        self._bound_centers = np.concatenate(self._centers, axis=1).T + axes * heights[:, None]
        background = [things[thing].background for thing in self.thing_of_part]
        self._extents = {
            n: _extent(self.parts[n], bounds[n]) for n in np.flatnonzero(background).tolist()
        }
        """Of parts of the background, which are large: two corners of a box around each."""
        self._boxes = {n for n in self._extents if _is_upright_box(self.parts[n])}
        # Which rays come near is decided in float32 with a millimetre to spare.
        self._bound_radii2 = np.array([[(radius + 1e-3) ** 2] for _, radius in bounds], np.float32)
        names = np.array([things[thing].name for thing in self.thing_of_part])
        self._table, self._floor = (
            np.flatnonzero(names == word).tolist() for word in ("wooden table", "tiled floor")
        )
        self._casters = range(self._table[-1] + 1)

    @functools.cached_property
    def shades(self) -> dict[int, Shade]:
        """Shadows on the table's top and on the floor, by part number; cast when the first ray asks.

        What stands on the table shades its top, the table the floor; a light whose shadows fall on things is kept from both by both.
        """
        table, floor = self._table[0], self._floor[0]
        return {
            table: self._shade(TABLE_RADIUS, 0.0, range(table)),
            floor: self._shade(ROOM, FLOOR, self._table),
        }

    def lamp_share(
        self,
        hits: Hits,
        point: Float[np.ndarray, "3 n"],
        normal: Float[np.ndarray, "3 n"],
        faces: Bool[np.ndarray, " n"],
    ) -> Float[np.ndarray, " n"]:
        """Share of the lamp that reaches each hit point.

        The table's top and the floor look it up on a grid. Elsewhere it is 1, or with a light whose shadows fall on things, counted.

        Args:
            hits: What was hit.
            point: Where, in metres.
            normal: Of the surface, on the side that is seen.
            faces: Which points look towards the lamp at all.
        """
        share = np.ones(hits.t.shape)
        counted = faces & (hits.part != NOTHING)
        for number, shade in self.shades.items():
            on = np.flatnonzero((hits.part == number) & (normal[2] > 0.9))
            share[on] = shade.at(point[:, on])
            counted[on] = False
        if self.light.on_things:
            share[~faces] = 0.0
            rays = np.flatnonzero(counted)
            share[rays] = self.counted_share((point + _LIFT * normal).take(rays, axis=1))
        return share

    def counted_share(self, origin: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
        """Share of the lamp that reaches each of any points: rays to it are dimmed by glass and stopped by all else."""
        goals = self.light.points().T
        along, squared = apply(origin.T, goals), (origin * origin).sum(0)[:, None]
        length2 = squared - 2 * along + (goals * goals).sum(0)
        through = np.ones(along.shape)
        blocked = self._between(origin)
        for number in self._casters:
            points = np.flatnonzero(blocked[number])
            center = self._bound_centers[number][None]
            # Squared distance of the sphere's centre from a ray, times the squared length of the ray.
            off = apply(center, origin.take(points, axis=1)).T - squared[points]
            ahead = apply(center, goals) - off - along[points]
            apart2 = (center * center).sum() - 2 * off - squared[points]
            near = (apart2 - self._bound_radii2[number]) * length2[points] <= ahead * ahead
            row, goal = np.nonzero(near & (through[points] > 0))
            row = points[row]
            start = origin.take(row, axis=1)
            direction = goals.take(goal, axis=1) - start
            length = np.sqrt((direction * direction).sum(0))
            t, _ = self._intersect(number, start, direction / length, np.zeros(row.size))
            glass = self.parts[number].material.kind == "glass"
            hit = t < length
            through[row[hit], goal[hit]] *= _GLASS_PASSES if glass else 0.0
        return through.mean(axis=1)

    def _between(self, origin: Float[np.ndarray, "3 n"]) -> Bool[np.ndarray, "parts n"]:
        """Which parts' bounding spheres reach into the cone from a point to the lamp."""
        start = origin.astype(np.float32)
        axis = np.array(self.light.center, np.float32)[:, None] - start
        length = np.sqrt((axis * axis).sum(0))
        axis /= length
        near = np.empty((len(self._casters), origin.shape[1]), bool)
        for number in self._casters:
            radius = float(self._bound_radii2[number, 0]) ** 0.5
            offset = self._bound_centers[number].astype(np.float32)[:, None] - start
            along = (offset * axis).sum(0)
            apart2 = (offset * offset).sum(0) - along * along
            # A ray that meets the sphere does so at this share of its way at most: that far the cone has opened.
            way = (along + radius) / np.maximum(length - self.light.radius, 1e-3)
            reach = radius + self.light.radius * np.clip(way, 0.0, 1.0)
            near[number] = (way > 0) & (apart2 <= reach * reach)
        return near

    def _shade(self, half: float, height: float, casters: Sequence[int]) -> Shade:
        """Look from every grid point at the points of the lamp.

        Only `casters` stand between them under the lamp at the ceiling.
        """
        steps = np.linspace(-half, half, _SHADOW_CELLS)
        x, y = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
        origin = np.stack([x, y, np.full(x.shape, height + _LIFT)])
        if self.light.on_things:
            return Shade(half, self.counted_share(origin).reshape(_SHADOW_CELLS, _SHADOW_CELLS))
        light, goals = np.zeros(x.size), self.light.points()
        for goal in goals:
            direction = goal[:, None] - origin
            direction /= np.sqrt((direction**2).sum(0))
            through = np.ones(x.size)
            near = self._near(origin, direction, casters)
            for row, number in enumerate(casters):
                rays = np.flatnonzero(near[row] & (through > 0))
                start, towards = origin.take(rays, axis=1), direction.take(rays, axis=1)
                t, _ = self._intersect(number, start, towards, np.zeros(rays.size))
                glass = self.parts[number].material.kind == "glass"
                through[rays[np.isfinite(t)]] *= _GLASS_PASSES if glass else 0.0
            light += through
        return Shade(half, (light / len(goals)).reshape(_SHADOW_CELLS, _SHADOW_CELLS))

    def _near(
        self,
        origin: Vectors,
        direction: Float[np.ndarray, "3 n"],
        parts: Sequence[int] | slice = slice(None),
    ) -> Bool[np.ndarray, "parts n"]:
        """Which rays pass through the bounding sphere of which part, or of which of some parts."""
        count = direction.shape[1]
        bound_centers, bound_radii2 = self._bound_centers[parts], self._bound_radii2[parts]
        near = np.empty((len(bound_centers), count), bool)
        offset = bound_centers - origin.T if origin.shape[1] == 1 else None
        for first in range(0, count, _NEAR_BLOCK):
            rays = slice(first, first + _NEAR_BLOCK)
            towards = direction[:, rays]
            if offset is not None:
                distance2 = (offset * offset).sum(1, keepdims=True).astype(np.float32)
                along = apply(offset.astype(np.float32), towards.astype(np.float32))
            else:
                own, centers = origin[:, rays], bound_centers.astype(np.float32)
                start = own.astype(np.float32)
                distance2 = apply(-2 * centers, start)
                distance2 += (centers * centers).sum(1, keepdims=True) + (start * start).sum(0)
                along = apply(centers, towards.astype(np.float32))
                along -= (own * towards).sum(0).astype(np.float32)
            np.greater_equal(along * along, distance2 - bound_radii2, out=near[:, rays])
        return near

    def _intersect(
        self,
        number: int,
        origin: Vectors,
        direction: Float[np.ndarray, "3 n"],
        t_min: Float[np.ndarray, " n"],
    ) -> tuple[Float[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
        rotation, center = self._rotations[number].T, self._centers[number]
        start, towards = apply(rotation, origin - center), apply(rotation, direction)
        return self.parts[number].shape.intersect(start, towards, t_min)

    def first_hit(
        self, origin: Vectors, direction: Float[np.ndarray, "3 n"], t_min: Float[np.ndarray, " n"]
    ) -> Hits:
        """Nearest surface beyond `t_min` along each ray."""
        count = direction.shape[1]
        best = np.full(count, np.inf)
        part, face = np.full(count, NOTHING, np.uint8), np.zeros(count, np.uint8)
        near = self._near(origin, direction)
        for number in range(len(self.parts)):
            rays = np.flatnonzero(near[number])
            if number in self._extents:
                rays = rays[self._comes_closer(number, rays, origin, direction, best)]
            if not rays.size:
                continue
            start = origin if origin.shape[1] == 1 else origin.take(rays, axis=1)
            t, side = self._intersect(number, start, direction.take(rays, axis=1), t_min[rays])
            closer = t < best[rays]
            rays = rays[closer]
            best[rays], part[rays], face[rays] = t[closer], number, side[closer]
        return Hits(best, part, face)

    def _comes_closer(
        self,
        number: int,
        rays: Int[np.ndarray, " r"],
        origin: Vectors,
        direction: Float[np.ndarray, "3 n"],
        best: Float[np.ndarray, " n"],
    ) -> Bool[np.ndarray, " r"]:
        """Which rays may meet a part of the background before the best hit that they have.

        No ray does whose way up to there stays above or below the part, or inside of a box.
        """
        low, high = self._extents[number]
        length = best.take(rays)
        first, last = _way(origin[2], direction[2], rays, length)
        apart = (first > high[2] + _HAIR) | (last < low[2] - _HAIR)
        if number in self._boxes:
            inside = (first > low[2] + _HAIR) & (last < high[2] - _HAIR)
            for axis in (0, 1):
                first, last = _way(origin[axis], direction[axis], rays, length)
                inside &= (first > low[axis] + _HAIR) & (last < high[axis] - _HAIR)
            apart |= inside
        return ~apart

    def surface(
        self, hits: Hits, point: Float[np.ndarray, "3 n"]
    ) -> tuple[Float[np.ndarray, "3 n"], Float[np.ndarray, "3 n"], UInt16[np.ndarray, " n"]]:
        """Colour before light, outward normal and patch at the hit points."""
        color, normal = np.zeros_like(point), np.zeros_like(point)
        normal[2] = 1.0
        patch = np.zeros(hits.part.shape, np.uint16)
        for number, rays in by_part(hits.part):
            local = apply(
                self._rotations[number].T, point.take(rays, axis=1) - self._centers[number]
            )
            color[:, rays], patch[rays] = self.parts[number].material.pattern(local)
            outward = self.parts[number].shape.normal(local, hits.face[rays])
            normal[:, rays] = apply(self._rotations[number], outward)
        return color, normal, patch


def apply(
    matrix: Float[np.ndarray, "p 3"], vectors: Float[np.ndarray, "3 n"]
) -> Float[np.ndarray, "p n"]:
    """Matrix times vectors without BLAS, whose threads cost more than they bring here and may move the last bit."""
    return np.einsum("pi,in->pn", matrix, vectors)


def by_part(part: UInt8[np.ndarray, " n"]) -> list[tuple[int, np.ndarray]]:
    """Ray numbers of every part that was hit."""
    order = np.argsort(part, kind="stable")
    numbers, starts = np.unique(part[order], return_index=True)
    groups = np.split(order, starts[1:])
    return [(int(n), rays) for n, rays in zip(numbers, groups, strict=True) if n != NOTHING]


def _extent(part: Part, bound: tuple[float, float]) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest coordinates of a part; wider than it is where it is turned."""
    center, half = np.array(part.center), np.full(3, abs(bound[0]) + bound[1])
    shape = part.shape
    if _is_upright_box(part) and isinstance(shape, Box):
        half = np.array(shape.half)
    if isinstance(shape, Revolution) and part.rotation == Part.rotation:
        reach = np.array([bound[1], bound[1], 0.0])
        ends = np.array([[0.0, 0.0, shape.low], [0.0, 0.0, shape.high]])
        return center + ends + np.stack([-reach, reach])
    return np.stack([center - half, center + half])


def _is_upright_box(part: Part) -> bool:
    return isinstance(part.shape, Box) and part.rotation == Part.rotation


def _way(
    origin: Float[np.ndarray, " m"],
    direction: Float[np.ndarray, " n"],
    rays: Int[np.ndarray, " r"],
    length: Float[np.ndarray, " r"],
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, " r"]]:
    """Lowest and highest coordinate of chosen rays up to a length, along one axis."""
    start = origin if origin.shape[0] == 1 else origin.take(rays)
    with np.errstate(invalid="ignore"):  # without a hit, along a plane: NaN, nowhere
        end = start + length * direction.take(rays)
    return np.minimum(start, end), np.maximum(start, end)
