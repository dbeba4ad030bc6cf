"""Surfaces that a ray can be intersected with, each in its own frame.

Vectors are component-first, ``[3, n]``, so that one component is one contiguous row. Directions have unit length, and
``t`` is a distance in metres. Everything is float64.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

Vectors = Float[np.ndarray, "3 #n"]
"""One vector per ray, or one for all of them."""


@runtime_checkable
class Shape(Protocol):
    """A surface in its own frame."""

    def bound(self) -> tuple[float, float]:
        """Height on the z axis of the centre, and radius, of a sphere that holds the surface."""
        ...

    def intersect(
        self, origin: Vectors, direction: Vectors, t_min: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
        """Distance to the first hit beyond `t_min` (inf where there is none) and the face that was hit."""
        ...

    def normal(
        self, point: Float[np.ndarray, "3 n"], face: UInt8[np.ndarray, " n"]
    ) -> Float[np.ndarray, "3 n"]:
        """Outward unit normal at points of the surface."""
        ...


@dataclass(frozen=True)
class Revolution:
    """The surface ``x^2 + y^2 = a + b z + c z^2`` between two heights, with or without its end discs.

    Spheres, ellipsoids, cylinders, cones and the waists and bellies of vases are all of this kind. Face 0 is the side, 1
    the lower disc, 2 the upper one.
    """

    a: float
    b: float
    c: float
    low: float
    high: float
    closed_low: bool = True
    closed_high: bool = True

    def radius2(self, z: float) -> float:
        """Squared radius at a height."""
        return max(self.a + self.b * z + self.c * z * z, 0.0)

    def bound(self) -> tuple[float, float]:
        """See `Shape.bound`."""
        middle = (self.low + self.high) / 2
        # Squared distance to the middle is a quadratic in z: its maximum is at an end or at the vertex.
        heights = [self.low, self.high]
        if self.c < -1:
            vertex = (2 * middle - self.b) / (2 * (self.c + 1))
            heights.append(min(max(vertex, self.low), self.high))
        return middle, max(self.radius2(z) + (z - middle) ** 2 for z in heights) ** 0.5

    def intersect(
        self, origin: Vectors, direction: Vectors, t_min: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
        """See `Shape.intersect`."""
        ox, oy, oz = origin
        dx, dy, dz = direction
        qa = dx * dx + dy * dy - self.c * dz * dz
        qb = ox * dx + oy * dy - dz * (self.b / 2 + self.c * oz)
        qc = ox * ox + oy * oy - (self.a + oz * (self.b + self.c * oz))
        best = np.full(t_min.shape, np.inf)
        face = np.zeros(t_min.shape, np.uint8)
        # Rays that miss give NaN and rays along the surface give inf; both lose every comparison below.
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            q = -(qb + np.copysign(np.sqrt(qb * qb - qa * qc), qb))
            for t in (q / qa, qc / q):
                z = oz + t * dz
                hit = (t > t_min) & (t < best) & (z >= self.low) & (z <= self.high)
                best = np.where(hit, t, best)
            for number, height, closed in (
                (1, self.low, self.closed_low),
                (2, self.high, self.closed_high),
            ):
                if not closed:
                    continue
                t = (height - oz) / dz
                inside = (ox + t * dx) ** 2 + (oy + t * dy) ** 2 <= self.radius2(height)
                hit = inside & (t > t_min) & (t < best)
                best = np.where(hit, t, best)
                face[hit] = number
        return best, face

    def normal(
        self, point: Float[np.ndarray, "3 n"], face: UInt8[np.ndarray, " n"]
    ) -> Float[np.ndarray, "3 n"]:
        """See `Shape.normal`."""
        x, y, z = point
        gradient = np.stack([x, y, -(self.b / 2 + self.c * z)])
        gradient /= np.sqrt((gradient**2).sum(0)) + 1e-12
        for number, sign in ((1, -1.0), (2, 1.0)):
            gradient[:, face == number] = np.array([[0.0], [0.0], [sign]])
        return gradient


@dataclass(frozen=True)
class Box:
    """An axis-aligned box around the origin. Face 2 i + 1 is the positive side of axis i, face 2 i the negative one."""

    half: tuple[float, float, float]

    def bound(self) -> tuple[float, float]:
        """See `Shape.bound`."""
        return 0.0, float(np.linalg.norm(self.half))

    def intersect(
        self, origin: Vectors, direction: Vectors, t_min: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
        """See `Shape.intersect`; from inside, the wall that the ray leaves through is hit."""
        near, far = np.full(t_min.shape, -np.inf), np.full(t_min.shape, np.inf)
        near_face, far_face = np.zeros(t_min.shape, np.uint8), np.zeros(t_min.shape, np.uint8)
        with np.errstate(invalid="ignore", divide="ignore"):
            for axis, half in enumerate(self.half):
                inverse = 1 / direction[axis]
                middle, width = -origin[axis] * inverse, half * np.abs(inverse)
                towards = (direction[axis] > 0).astype(np.uint8)
                later, sooner = middle - width > near, middle + width < far
                near = np.where(later, middle - width, near)
                near_face = np.where(later, np.uint8(2 * axis + 1) - towards, near_face)
                far = np.where(sooner, middle + width, far)
                far_face = np.where(sooner, np.uint8(2 * axis) + towards, far_face)
        outside = near > t_min
        t = np.where(outside, near, far)
        hit = (near <= far) & (t > t_min)
        return np.where(hit, t, np.inf), np.where(outside, near_face, far_face)

    def normal(
        self, point: Float[np.ndarray, "3 n"], face: UInt8[np.ndarray, " n"]
    ) -> Float[np.ndarray, "3 n"]:
        """See `Shape.normal`."""
        normal = np.zeros_like(point)
        normal[face // 2, np.arange(face.size)] = 2.0 * (face % 2) - 1.0
        return normal


@dataclass(frozen=True)
class Torus:
    """A ring around the z axis: `major` is the radius of its centre line, `minor` that of the tube."""

    major: float
    minor: float

    def bound(self) -> tuple[float, float]:
        """See `Shape.bound`."""
        return 0.0, self.major + self.minor

    def _distance(self, point: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
        return np.hypot(np.hypot(point[0], point[1]) - self.major, point[2]) - self.minor

    def intersect(
        self, origin: Vectors, direction: Vectors, t_min: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
        """See `Shape.intersect`.

        The quartic loses digits where roots meet, which is along every silhouette. The exact distance to a torus is known,
        so the ray walks by it from the bounding sphere on, in small steps only where it grazes; Newton's rule polishes.
        """
        middle = -(origin * direction).sum(0)
        gap = (origin * origin).sum(0) - middle * middle
        reach = np.sqrt(np.maximum((self.major + self.minor) ** 2 - gap, 0.0))
        t, last = np.maximum(middle - reach, t_min), middle + reach
        origin = np.broadcast_to(origin, direction.shape)
        walking = np.flatnonzero((reach > 0) & (t < last))
        for _ in range(200):
            point = origin.take(walking, axis=1) + t[walking] * direction.take(walking, axis=1)
            step = np.abs(self._distance(point))
            t[walking] += step
            walking = walking[(step > 1e-5) & (t[walking] < last[walking])]
            if not walking.size:
                break
        no_face = np.zeros(t_min.shape, np.uint8)
        for _ in range(4):
            point = origin + t * direction
            slope = (self.normal(point, no_face) * direction).sum(0)
            t = t - self._distance(point) / np.where(np.abs(slope) > 1e-3, slope, np.inf)
        miss = np.abs(self._distance(origin + t * direction))
        hit = (miss < 1e-7) & (t > t_min) & (t <= last) & (reach > 0)
        return np.where(hit, t, np.inf), no_face

    def normal(
        self, point: Float[np.ndarray, "3 n"], face: UInt8[np.ndarray, " n"]
    ) -> Float[np.ndarray, "3 n"]:
        """See `Shape.normal`."""
        ring = np.hypot(point[0], point[1]) + 1e-12
        away = 1 - self.major / ring
        normal = np.stack([point[0] * away, point[1] * away, point[2]])
        return normal / (np.sqrt((normal**2).sum(0)) + 1e-12)


def sphere(radius: float) -> Revolution:
    """A sphere around the origin."""
    return ellipsoid(radius, radius)


def ellipsoid(radius: float, half_height: float) -> Revolution:
    """An ellipsoid of revolution around the origin."""
    squash = -((radius / half_height) ** 2)
    return Revolution(radius**2, 0.0, squash, -half_height, half_height, False, False)


def cylinder(radius: float, height: float, *, open_top: bool = False) -> Revolution:
    """A cylinder standing on z = 0."""
    return Revolution(radius**2, 0.0, 0.0, 0.0, height, True, not open_top)


def cone(bottom: float, top: float, height: float, *, open_top: bool = False) -> Revolution:
    """A cone or its frustum standing on z = 0, with the two radii."""
    slope = (top - bottom) / height
    return Revolution(bottom**2, 2 * bottom * slope, slope**2, 0.0, height, True, not open_top)


def turned(
    heights: tuple[float, float, float],
    radii: tuple[float, float, float],
    *,
    closed_low: bool = True,
    closed_high: bool = True,
) -> Revolution:
    """The surface of revolution whose squared radius is the parabola through three (height, radius) pairs."""
    c, b, a = np.polyfit(heights, np.square(radii), 2).tolist()
    return Revolution(a, b, c, heights[0], heights[2], closed_low, closed_high)
