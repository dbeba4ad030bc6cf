"""The ``.compressed.ply`` of PlayCanvas and SuperSplat: 16 bytes a Gaussian, and one for each harmonic.

    chunk   18 float32 for 256 Gaussians: least and largest position, logarithm of scale, colour
    vertex  4 uint32 a Gaussian, highest bits first
            packed_position  11 10 11 bits x y z, between the chunk's bounds
            packed_rotation  2 bits: which of w x y z is the largest; 10 bits each: the others, in [-1, 1] / sqrt(2)
            packed_scale     11 10 11 bits
            packed_color     8 8 8 8 bits red green blue opacity
    sh      uint8 f_rest_0 ..., in [-4, 4]; only where there are harmonics above degree 0

The Gaussians stand along a Morton curve, so that those of a chunk are near to each other and its bounds tight. SuperSplat's own
writer does the same; what is read back is off by at most half a step of what the bits hold.
"""

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt32
from plyfile import PlyData, PlyElement
from torch import Tensor

from vlgs.files import write_atomically
from vlgs.gaussians.sh import sh_to_rgb

CHUNK = 256
_MOST_LOG_SCALE = 20.0
"""Scales beyond exp(+-20) are clamped, as SuperSplat does."""


def write_compressed(path: str | Path, params: Mapping[str, Tensor]) -> None:
    """Write what the format keeps of raw parameters that are sound; the order of the Gaussians is not kept.

    Raises:
        OSError: If the file cannot be written.
    """
    means = params["means"].detach().double().numpy()
    rows = morton_order(params["means"])
    chunks, vertices = [], np.empty((len(rows), 4), np.uint32)
    scales = params["log_scales"].detach().double().clamp(-_MOST_LOG_SCALE, _MOST_LOG_SCALE)
    bounded = (means, scales.numpy(), sh_to_rgb(params["sh0"].detach().double()).numpy())
    rotations = _pack_rotations(params["quats"].detach().double().numpy())
    opacities = params["opacity_logits"].detach().double().sigmoid().numpy()
    for start in range(0, len(rows), CHUNK):
        own = rows[start : start + CHUNK]
        low = [value[own].min(axis=0).astype(np.float32) for value in bounded]
        high = [value[own].max(axis=0).astype(np.float32) for value in bounded]
        chunks.append(np.concatenate([low[0], high[0], low[1], high[1], low[2], high[2]]))
        shares = [_between(v[own], a, b) for v, a, b in zip(bounded, low, high, strict=True)]
        packed = vertices[start : start + CHUNK]
        packed[:, 0] = _pack(shares[0], (11, 10, 11))
        packed[:, 1] = rotations[own]
        packed[:, 2] = _pack(shares[1], (11, 10, 11))
        packed[:, 3] = _pack(np.column_stack([shares[2], opacities[own]]), (8, 8, 8, 8))
    elements = [
        _element("chunk", _CHUNK_COLUMNS, np.reshape(chunks, (-1, 18)), "<f4"),
        _element("vertex", _VERTEX_COLUMNS, vertices, "<u4"),
    ]
    harmonics = params["shN"].detach().double().mT.flatten(1).numpy()  # all of red, green, blue
    if harmonics.shape[1]:
        levels = np.floor((harmonics[rows] / 8 + 0.5) * 256).clip(0, 255)
        names = [f"f_rest_{k}" for k in range(harmonics.shape[1])]
        elements.append(_element("sh", names, levels, "u1"))
    stream = io.BytesIO()
    PlyData(elements, byte_order="<").write(stream)
    write_atomically(Path(path), stream.getvalue())


def morton_order(means: Float[Tensor, "n 3"]) -> Int[np.ndarray, " n"]:
    """Rows along a curve that visits what is near one after the other: bits of x, y and z interleaved."""
    places = means.detach().double().numpy()
    if len(places) == 0:
        return np.arange(0)
    low, span = places.min(axis=0), np.ptp(places, axis=0)
    cells = ((places - low) / np.where(span > 0, span, 1) * 1023).astype(np.uint32)
    code = np.zeros(len(places), np.uint32)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _bounds(ends: tuple[str, str], names: tuple[str, ...]) -> list[str]:
    return [f"{end}_{name}" for end in ends for name in names]


_XYZ = ("x", "y", "z")
_CHUNK_COLUMNS = [
    *_bounds(("min", "max"), _XYZ),
    *_bounds(("min_scale", "max_scale"), _XYZ),
    *_bounds(("min", "max"), ("r", "g", "b")),
]
_VERTEX_COLUMNS = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]


def _element(name: str, columns: list[str], values: np.ndarray, kind: str) -> PlyElement:
    rows = np.empty(len(values), dtype=[(column, kind) for column in columns])
    for index, column in enumerate(columns):
        rows[column] = values[:, index]
    return PlyElement.describe(rows, name)


def _between(value: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Where values lie between bounds, in [0, 1]; 0 where the bounds are one."""
    span = high.astype(np.float64) - low
    return ((value - low) / np.where(span > 0, span, np.inf)).clip(0, 1)


def _pack(shares: Float[np.ndarray, "n c"], bits: tuple[int, ...]) -> UInt32[np.ndarray, " n"]:
    """Shares of 1 in one word, the first in the highest bits."""
    word = np.zeros(len(shares), np.uint32)
    for share, count in zip(shares.T, bits, strict=True):
        word = word << count | np.round(share * ((1 << count) - 1)).astype(np.uint32)
    return word


def _pack_rotations(quats: Float[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(axis=1)
    unit *= np.sign(np.take_along_axis(unit, largest[:, None], axis=1))  # -q turns as q does
    others = np.array([[k for k in range(4) if k != skip] for skip in range(4)])[largest]
    shares = np.take_along_axis(unit, others, axis=1) * 2**-0.5 + 0.5
    packed = _pack(shares.clip(0, 1), (10, 10, 10))
    return packed | largest.astype(np.uint32) << 30
