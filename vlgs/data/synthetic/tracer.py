"""An analytic ray tracer: rays in, colours and first surfaces out.

It shares no code and no formula with the rasterizer. Light is Lambert's from one lamp plus an ambient part that is
brighter from above. Soft shadows lie on the table and on the floor; those of things on things are dear, and small under a lamp
at the ceiling: they are cast where a scene has a light of its own. Glass is a stack of thin panes, blended without refraction and
denser at grazing angles; steel shows the room after one bounce. Colours are blended as displayed, in [0, 1], which is what a
splatting model does too.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16

from vlgs.data.synthetic.shapes import Vectors
from vlgs.data.synthetic.world import NOTHING, Hits, World, by_part

PANE = 0.72
"""Brightness of white glass seen face on; towards its edges it grows to 1.07."""

_SKIP = 1e-5  # a ray that leaves a surface starts this far from it, in metres
_PANES = 12  # panes behind each other that are looked through
_OPAQUE = 0.02  # what less than this still shines through is left out


@dataclass(frozen=True)
class Traced:
    """What rays see."""

    color: Float[np.ndarray, "3 n"]
    """In [0, 1]."""
    first: Hits
    """First surface, be it glass or not."""
    patch: UInt16[np.ndarray, " n"]
    """Patch of the first surface."""


def trace(
    world: World, origin: Vectors, direction: Float[np.ndarray, "3 n"], bounces: int = 1
) -> Traced:
    """Follow rays through any number of panes to an opaque surface, and once more where that is a mirror.

    Args:
        world: What is looked at.
        origin: Where rays start, in metres; one column for all, or one each.
        direction: Unit vectors.
        bounces: How often a mirror may be looked into; a mirror seen in the last one is plain grey.
    """
    count = direction.shape[1]
    color, clear = np.zeros((3, count)), np.ones(count)
    t_min = np.full(count, _SKIP)
    first = world.first_hit(origin, direction, t_min)
    hits, rays = first, np.arange(count)
    patch = np.zeros(count, np.uint16)
    for pane in range(_PANES):
        start = origin if origin.shape[1] == 1 else origin.take(rays, axis=1)
        seen, cover, patches = _shade(world, hits, start, direction.take(rays, axis=1), bounces)
        if pane == 0:
            patch = patches
        color[:, rays] += clear[rays] * cover * seen
        clear[rays] *= 1 - cover
        on = (clear[rays] > _OPAQUE) & np.isfinite(hits.t)
        t_min, rays = hits.t[on] + _SKIP, rays[on]
        if not rays.size:
            break
        start = origin if origin.shape[1] == 1 else origin.take(rays, axis=1)
        hits = world.first_hit(start, direction.take(rays, axis=1), t_min)
    return Traced(np.clip(color, 0.0, 1.0), first, patch)


def _shade(
    world: World, hits: Hits, origin: Vectors, direction: Float[np.ndarray, "3 n"], bounces: int
) -> tuple[Float[np.ndarray, "3 n"], Float[np.ndarray, " n"], UInt16[np.ndarray, " n"]]:
    """Colour, cover in [0, 1] and patch of one layer of surfaces."""
    point = origin + np.where(np.isfinite(hits.t), hits.t, 0.0) * direction
    albedo, normal, patch = world.surface(hits, point)
    facing = (normal * direction).sum(0)
    normal *= -np.sign(facing)
    facing = np.abs(facing)

    to_lamp = np.array(world.light.center)[:, None] - point
    to_lamp /= np.sqrt((to_lamp**2).sum(0))
    lit = np.maximum((normal * to_lamp).sum(0), 0.0)
    arrives = world.lamp_share(hits, point, normal, lit > 0)
    lit *= arrives
    ambient = world.light.ambient + 0.10 * normal[2]
    color = albedo * (ambient + world.light.power * lit)
    cover = np.ones(hits.t.shape)
    for number, rays in by_part(hits.part):
        material = world.parts[number].material
        shine = 0.0
        if material.gloss:
            shine = material.gloss * _glare(normal[:, rays], to_lamp[:, rays] - direction[:, rays])
            shine *= arrives[rays]
        if material.kind == "light":
            color[:, rays] = albedo[:, rays]
        elif material.kind == "glass":
            edge = (1 - facing[rays]) ** 3
            cover[rays] = np.clip(
                material.opacity + (0.75 - material.opacity) * edge + shine, 0.0, 1.0
            )
            color[:, rays] = albedo[:, rays] * (PANE + 0.35 * edge) + shine
        elif material.kind == "mirror" and bounces > 0:
            away = direction[:, rays] + 2 * facing[rays] * normal[:, rays]
            room = trace(world, point[:, rays] + 1e-4 * normal[:, rays], away, bounces - 1).color
            share = material.reflectance
            color[:, rays] = (
                albedo[:, rays] * (share * room + (1 - share) * (0.4 + 0.5 * lit[rays])) + shine
            )
        else:
            color[:, rays] += shine
    color[:, hits.part == NOTHING] = 0.0
    return color, cover, patch


def _glare(
    normal: Float[np.ndarray, "3 n"], between: Float[np.ndarray, "3 n"]
) -> Float[np.ndarray, " n"]:
    """Blinn's highlight: the 40th power of the cosine between the normal and the bisector of light and view."""
    length = np.sqrt((between * between).sum(0)) + 1e-12
    power8 = (np.maximum((normal * between).sum(0), 0.0) / length) ** 2
    power8 *= power8
    power8 *= power8
    power16 = power8 * power8
    return power16 * power16 * power8
