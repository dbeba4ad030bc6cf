"""Where photographs are taken from: a walk around the table, three times to and fro, from low to high; or a ring, or an arc."""

from dataclasses import dataclass

import numpy as np
import torch

from vlgs.geometry import pose_matrix
from vlgs.types import Camera

ARC = 105.0
"""The walk reaches this many degrees to either side of the negative y axis."""
LOW, HIGH = 16.0, 48.0
"""Degrees above the table at the start and at the end."""
NEAR, FAR = 1.30, 1.55
"""Distance to the middle of the table in metres."""
FIELD_OF_VIEW = 52.0
"""Horizontal, degrees."""
RING = 1.5
"""Radius of ring and arc in metres."""
HALF_ARC = 55.0
"""An arc reaches this many degrees to either side of the negative y axis."""
BEYOND, PAST, ABOVE = 1.15, 8.0, 9.0
"""Held-out views: so many times the ring's radius, degrees past the ends of the arc, degrees above the higher training views. More would show
mostly what no training view has seen, which is chance."""
_HEIGHTS = {"ring": (20.0, 32.0), "sky": (8.0, 20.0), "wall": (12.0, 28.0)}
_SWEEPS = 3
_TARGET = np.array([0.0, 0.0, 0.07])


def moments(train: int, test: int) -> tuple[np.ndarray, np.ndarray]:
    """When along the walk, in [0, 1], training and held-out photographs are taken.

    Training views are evenly spaced; held-out ones lie halfway between two of them, spread over the whole walk. No two
    moments are equal as long as there are fewer held-out views than training views.
    """
    gaps = max(train - 1, 1)
    between = np.floor((np.arange(test) + 0.5) * gaps / max(test, 1)) + 0.5
    return np.arange(train) / gaps, between / gaps


def camera_at(moment: float, rng: np.random.Generator, width: int, height: int) -> Camera:
    """The camera at one moment of the walk, held by a hand: a few centimetres and degrees off the ideal path."""
    phase = moment * _SWEEPS
    swing = (
        abs((phase + 1) % 2 - 1) * 2 - 1
    )  # a triangle wave: constant speed, also at the turning points
    azimuth = np.radians(-90 + ARC * swing + rng.normal(0, 1.0))
    elevation = np.radians(LOW + (HIGH - LOW) * moment + rng.normal(0, 1.0))
    distance = NEAR + (FAR - NEAR) * (0.5 + 0.5 * np.sin(7.0 * moment)) + rng.normal(0, 0.01)
    return _look(azimuth, elevation, distance, rng, width, height)


@dataclass(frozen=True)
class Stop:
    """Where a photographer stops on a ring or an arc."""

    azimuth: float
    """Degrees."""
    elevation: float
    """Degrees above the table."""
    distance: float
    """Metres to the middle of the table."""


def stop_at(stage: str, number: int, train: int, held_out: int = 0) -> Stop:
    """Place of one photograph of `vlgs.data.synthetic.outdoors`.

    Training views stand evenly around, low and high in turn. Of the held-out ones, spread as evenly, every second is halfway
    between two of them; the others are in turn beyond (of a ring farther out, of an arc past its ends) and above.

    Args:
        stage: ``ring`` and ``sky`` are seen from a ring, ``wall`` from an arc.
        number: Among the training or the held-out views.
        train: How many training views there are.
        held_out: How many held-out views there are; 0 asks for a training view.
    """
    ring = stage != "wall"
    low, high = _HEIGHTS[stage]
    gaps = train if ring else train - 1
    place = float(number)
    if held_out:
        place = np.floor((number + 0.5) * gaps / held_out) + 0.5
    elevation = (low + high) / 2 if held_out else (low, high)[number % 2]
    kind = ("between", "beyond", "between", "above")[number % 4] if held_out else "between"
    distance = RING * (BEYOND if kind == "beyond" and ring else 1.0)
    if kind == "above":
        elevation = high + ABOVE
    if ring:
        return Stop(-90 + 360 * place / gaps, elevation, distance)
    azimuth = HALF_ARC * (2 * place / gaps - 1)
    if kind == "beyond":
        azimuth = np.copysign(HALF_ARC + PAST, azimuth)
    return Stop(-90 + azimuth, elevation, distance)


def held(stop: Stop, rng: np.random.Generator, width: int, height: int) -> Camera:
    """The camera at a stop, held by a hand."""
    azimuth = np.radians(stop.azimuth + rng.normal(0, 1.0))
    elevation = np.radians(stop.elevation + rng.normal(0, 1.0))
    return _look(azimuth, elevation, stop.distance + rng.normal(0, 0.01), rng, width, height)


def _look(
    azimuth: float,
    elevation: float,
    distance: float,
    rng: np.random.Generator,
    width: int,
    height: int,
) -> Camera:
    center = _TARGET + distance * np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    forward = _TARGET + rng.normal(0, 0.02, 3) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = pose_matrix(torch.from_numpy(rotation), torch.from_numpy(center)).float()
    focal = 0.5 * width / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    rows = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
    return Camera(viewmat, torch.tensor(rows, dtype=torch.float32), width, height)
