"""Where photographs are taken from: a walk around the table, three times to and fro, from low to high."""

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
