"""A viewer of 3D Gaussians that knows nothing of vlgs: a file and a camera in, a picture out. Dense, NumPy, float64.

Written from Kerbl et al. 2023 with the constants of their release: covariances blurred by 0.3 pixel^2, alpha at most 0.99 and skipped
below 1/255, a pixel done before its transmittance falls under 1e-4, colour = 0.5 + harmonics, clamped at 0. No background.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from plyfile import PlyData

C0 = 0.28209479177387814


@dataclass(frozen=True)
class Pinhole:
    """World to camera, focal lengths and principal point, size in pixels."""

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int


def read_columns(path: Path) -> dict[str, np.ndarray]:
    vertices = PlyData.read(str(path))["vertex"].data
    return {name: vertices[name].astype(np.float64) for name in vertices.dtype.names}


def read_rows(path: Path) -> dict[str, np.ndarray]:
    """The 32-byte rows of a .splat under the names of a PLY."""
    kinds = [("p", "<f4", 3), ("s", "<f4", 3), ("c", "u1", 4), ("q", "u1", 4)]
    rows = np.frombuffer(path.read_bytes(), kinds)
    color = rows["c"] / 255.0
    with np.errstate(divide="ignore"):
        opacity = np.log(color[:, 3]) - np.log1p(-color[:, 3])
    columns = {"opacity": opacity}
    for i in range(3):
        columns["xyz"[i]] = rows["p"][:, i].astype(np.float64)
        columns[f"scale_{i}"] = np.log(rows["s"][:, i].astype(np.float64))
        columns[f"f_dc_{i}"] = (color[:, i] - 0.5) / C0
    return columns | {f"rot_{i}": (rows["q"][:, i] - 128.0) / 128.0 for i in range(4)}


def draw_color(columns: dict[str, np.ndarray], camera: Pinhole) -> np.ndarray:
    """What a 3DGS viewer shows."""
    return _blend(_colors(columns, camera), columns["opacity"], columns, "", camera)


def draw_language(columns: dict[str, np.ndarray], camera: Pinhole, levels: int = 1) -> np.ndarray:
    """Codes lang_* blended with the indicator, or those of each level with its own; in language's own shape where it has one."""
    names = sorted((n for n in columns if n.startswith("lang_")), key=lambda n: int(n[5:]))
    codes = np.stack([columns[name] for name in names], axis=1)
    weights = [columns[f"indicator_{i}"] for i in range(levels) if f"indicator_{i}" in columns]
    weights = weights or [columns["indicator"]]
    prefix = "language_" if "language_rot_0" in columns else ""
    images = [
        _blend(own, weight, columns, prefix, camera)
        for own, weight in zip(np.split(codes, len(weights), axis=1), weights, strict=True)
    ]
    return np.concatenate(images, axis=2)


def _stack(columns: dict[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    return np.stack([columns[name] for name in names], axis=1)


def _colors(columns: dict[str, np.ndarray], camera: Pinhole) -> np.ndarray:
    rotation, shift = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    way = _stack(columns, "xyz") + rotation.T @ shift
    x, y, z = (way / np.linalg.norm(way, axis=1, keepdims=True)).T
    # Condon-Shortley harmonics of degree 1 to 3, in the order and with the signs that 3DGS stores.
    basis = [
        -np.sqrt(3 / (4 * np.pi)) * y,
        np.sqrt(3 / (4 * np.pi)) * z,
        -np.sqrt(3 / (4 * np.pi)) * x,
        np.sqrt(15 / (4 * np.pi)) * x * y,
        -np.sqrt(15 / (4 * np.pi)) * y * z,
        np.sqrt(5 / (16 * np.pi)) * (3 * z**2 - 1),
        -np.sqrt(15 / (4 * np.pi)) * x * z,
        np.sqrt(15 / (16 * np.pi)) * (x**2 - y**2),
        -np.sqrt(35 / (32 * np.pi)) * y * (3 * x**2 - y**2),
        np.sqrt(105 / (4 * np.pi)) * x * y * z,
        -np.sqrt(21 / (32 * np.pi)) * y * (5 * z**2 - 1),
        np.sqrt(7 / (16 * np.pi)) * z * (5 * z**2 - 3),
        -np.sqrt(21 / (32 * np.pi)) * x * (5 * z**2 - 1),
        np.sqrt(105 / (16 * np.pi)) * z * (x**2 - y**2),
        -np.sqrt(35 / (32 * np.pi)) * x * (x**2 - 3 * y**2),
    ]
    rest = sum(name.startswith("f_rest_") for name in columns) // 3
    color = 0.5 + C0 * _stack(columns, [f"f_dc_{c}" for c in range(3)])
    for c in range(3):
        for k in range(rest):
            color[:, c] += columns[f"f_rest_{c * rest + k}"] * basis[k]
    return np.maximum(color, 0)


def _blend(
    values: np.ndarray,
    logits: np.ndarray,
    columns: dict[str, np.ndarray],
    prefix: str,
    camera: Pinhole,
) -> np.ndarray:
    rotation, shift = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    place = _stack(columns, "xyz") @ rotation.T + shift
    order = np.argsort(place[:, 2], kind="stable")
    order = order[place[order, 2] > 0.01]  # 3DGS says 0.2, in scenes that are larger than ours
    place, values = place[order], values[order]
    weight = 1 / (1 + np.exp(-logits[order]))
    quats = _stack(columns, [f"{prefix}rot_{i}" for i in range(4)])[order]
    scales = np.exp(_stack(columns, [f"{prefix}scale_{i}" for i in range(3)])[order])
    covariance = _covariance(quats, scales)
    depth, size = place[:, 2], (camera.width, camera.height)
    project = np.zeros((len(order), 2, 3))
    mean = np.empty((len(order), 2))
    for i in range(2):
        focal, center = camera.K[i, i], camera.K[i, 2]
        slope = place[:, i] / depth
        mean[:, i] = focal * slope + center
        reach = 0.3 * size[i] / 2  # 1.3 times the half angle of view
        low, high = -(center + reach) / focal, (size[i] - center + reach) / focal
        project[:, i, i] = focal / depth
        project[:, i, 2] = -focal * np.clip(slope, low, high) / depth
    project = project @ rotation
    spread = project @ covariance @ project.transpose(0, 2, 1) + 0.3 * np.eye(2)
    image = np.empty((camera.height, camera.width, values.shape[1]))
    pixels = np.arange(camera.width) + 0.5
    # Above and below this no alpha of a Gaussian reaches 1/255.
    reach = np.sqrt(2 * np.log(255) * spread[:, 1, 1])
    for row in range(camera.height):
        near = np.abs(row + 0.5 - mean[:, 1]) <= reach
        dx, dy = pixels - mean[near, :1], row + 0.5 - mean[near, 1:]
        inverse = np.linalg.inv(spread[near])[..., None]
        distance = inverse[:, 0, 0] * dx**2 + 2 * inverse[:, 0, 1] * dx * dy
        distance += inverse[:, 1, 1] * dy**2
        alpha = np.minimum(0.99, weight[near, None] * np.exp(-0.5 * distance))
        alpha[alpha < 1 / 255] = 0
        after = np.cumprod(1 - alpha, axis=0)
        before = np.concatenate([np.ones((1, camera.width)), after[:-1]])
        image[row] = np.where(after < 1e-4, 0, alpha * before).T @ values[near]
    return image


def _covariance(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rotation = np.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        axis=1,
    ).reshape(-1, 3, 3)
    axes = rotation * scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)
