"""Photographs of a world: colours, and the exact first surface at every pixel centre."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from vlgs.data.synthetic.tracer import trace
from vlgs.data.synthetic.world import World
from vlgs.geometry import camera_center
from vlgs.types import Camera

_EDGE = 0.05  # a step of colour to a neighbour that makes a pixel worth more rays
_TURNED_SQUARE = np.array([[-1, -3], [3, -1], [1, 3], [-3, 1]]).T / 8
"""x and y offsets of four more rays: with the centre, five different columns and five different rows."""


@dataclass(frozen=True)
class TracedImage:
    """One image with its ground truth."""

    image: UInt8[np.ndarray, "h w 3"]
    part: UInt8[np.ndarray, "h w"]
    """Number of the part whose surface is first along the ray through the pixel's centre; glass counts."""
    patch: UInt16[np.ndarray, "h w"]
    """Its patch, see `vlgs.data.synthetic.patterns`."""
    distance: Float32[np.ndarray, "h w"]
    """Metres from the camera centre to that surface."""


def pixel_rays(
    camera: Camera, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "3 1"], Float[np.ndarray, "3 n"]]:
    """Camera centre and unit directions of the rays through image points, in world coordinates."""
    K, pose = camera.K.double().numpy(), camera.viewmat.double()
    local = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)])
    direction = pose[:3, :3].numpy().T @ local
    direction /= np.sqrt((direction**2).sum(0))
    return camera_center(pose).numpy()[:, None], direction


def exposures(stops: float, count: int, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
    """What the values of training photographs are multiplied by, as a camera with automatic exposure does.

    The gains are even steps between ``-stops`` and ``stops`` in a random order, divided by their mean, which is 1 from then on. The maps
    that `trainer.exposure` learns are the identity on average too, and without maps the mean is what squared errors are smallest
    for: either way the scene that explains the photographs best is the one that photographs of nominal exposure show. The gains
    multiply values as displayed, of which pictures here are made and which the maps multiply too; with a gamma of 2.2, a stop of these
    is 2.2 stops of light.
    """
    steps = (2 * rng.permutation(count) + 1) / count - 1
    gains = 2.0 ** (stops * steps)
    return gains / gains.mean()


def photograph(world: World, camera: Camera, gain: float = 1.0) -> TracedImage:
    """Trace one ray per pixel, then four more for every pixel that differs from a neighbour.

    Edges are smooth that way, and flat areas cost one ray. Labels are those of the pixel's centre and never averaged.

    Args:
        world: What is photographed.
        camera: From where.
        gain: What its values are multiplied by; those above 1 are lost.
    """
    width, height = camera.width, camera.height
    y, x = (axis.ravel() + 0.5 for axis in np.indices((height, width)).astype(np.float64))
    origin, direction = pixel_rays(camera, x, y)
    seen = trace(world, origin, direction)
    rough = np.flatnonzero(_edges(seen.color.reshape(3, height, width)))
    dx, dy = _TURNED_SQUARE
    _, fine = pixel_rays(camera, (x[rough, None] + dx).ravel(), (y[rough, None] + dy).ravel())
    more = trace(world, origin, fine).color.reshape(3, rough.size, -1).sum(-1)
    color = seen.color.copy()
    color[:, rough] = (color[:, rough] + more) / (1 + dx.size)
    image = np.round(np.minimum(gain * color.T, 1.0) * 255).astype(np.uint8)
    shape = (height, width)
    return TracedImage(
        image.reshape(*shape, 3),
        seen.first.part.reshape(shape),
        seen.patch.reshape(shape),
        seen.first.t.astype(np.float32).reshape(shape),
    )


def _edges(color: Float[np.ndarray, "3 h w"]) -> np.ndarray:
    edge = np.zeros(color.shape[1:], bool)
    down = np.abs(np.diff(color, axis=1)).max(0) > _EDGE
    across = np.abs(np.diff(color, axis=2)).max(0) > _EDGE
    edge[1:] |= down
    edge[:-1] |= down
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    return edge
