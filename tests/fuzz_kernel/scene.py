"""Hostile scenes for `tests.fuzz_kernel`, each a function of its seed alone.

Half of them are tame: every number is one that training can reach.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vlgs.types import ChannelGroup, Covariance, RasterConfig

POISON = (
    np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, -5e-324, 1e-45, 1e-40, -1e-40, 1.1754944e-38, 1e-38,
    -1e-38, 1e38, -1e38, 3.4028235e38, 1e300, -1e300, 1e-20, 1e20, 1 / 255, 0.99, 1.0, -1.0, 16.0,
)  # fmt: skip
"""What is strewn into any input."""

SWITCHES = ("tile_test", "block_masks", "opacity_extent", "share_chains")
"""Skips of `RasterConfig` that may be off."""

_ULP = 2.0**-24
WEIGHTS = (0.0, 1e-7, 1 / 255 * (1 - _ULP), 1 / 255, 1 / 255 * (1 + 2 * _ULP),
           0.99 * (1 - _ULP), 0.99, 0.99 * (1 + 2 * _ULP), 1.0)  # fmt: skip
"""Weights at the edges of the image model, an ulp of float32 to either side."""


@dataclass(frozen=True)
class FuzzScene:
    """Input of one call, as leaves."""

    tensors: dict[str, Tensor]
    """means, quats, scales, shape0.quats, shape0.scales, .., weight0, .., values0, .., viewmat, K."""
    chain_of: tuple[int, ...]
    """Weight of each group."""
    shape_of: tuple[int | None, ...]
    """Own shape of each group; None: the scene's."""
    shape_grads: tuple[bool, ...]
    width: int
    height: int
    config: RasterConfig
    upstream: tuple[Tensor, ...]
    """Gradients of images, then of alphas."""
    asked: tuple[str, ...]
    """Tensors whose gradients are asked for when not all are; may be none."""
    used: tuple[int, ...]
    """Pictures that are used when not all are; at least one."""
    threads: int
    tame: bool

    def leaves(self, *names: str) -> dict[str, Tensor]:
        """Copies of all tensors, of which those named want a gradient."""
        return {k: t.clone().requires_grad_(k in names) for k, t in self.tensors.items()}

    @property
    def differentiable(self) -> tuple[str, ...]:
        """All tensors that a gradient can reach."""
        return tuple(name for name in self.tensors if name not in ("viewmat", "K"))

    def groups(self, leaves: dict[str, Tensor]) -> list[ChannelGroup]:
        """The groups of some leaves; groups with one shape have the very same."""
        shapes = {
            k: Covariance(leaves[f"shape{k}.quats"], leaves[f"shape{k}.scales"])
            for k in set(self.shape_of) - {None}
        }
        return [
            ChannelGroup(leaves[f"values{i}"], leaves[f"weight{chain}"], grad, shapes.get(shape))
            for i, (chain, grad, shape) in enumerate(
                zip(self.chain_of, self.shape_grads, self.shape_of, strict=True)
            )
        ]


def make_scene(seed: int) -> FuzzScene:
    """The scene of a seed: up to 200 Gaussians, images up to 69 pixels wide, 1 to 5 groups of 1 to 40 channels.

    Half of all scenes have 3 channels per group, which the kernel holds in registers.
    """
    rng = np.random.default_rng(seed)
    tame = bool(rng.integers(2))
    n = int(rng.choice([0, 1, 2, 7, 40, int(rng.integers(201))]))
    width, height = (int(rng.choice([1, 16, 17, int(rng.integers(1, 70))])) for _ in range(2))
    count = int(rng.integers(1, 6))
    chain_of = tuple(int(rng.integers(i + 1)) for i in range(count))
    shape_of = _shape_of(rng, count)
    arrays = _arrays(rng, n, tame, chain_of, shape_of)
    focal = rng.uniform(0.3, 3, 2) * width
    center = rng.uniform(-1, 2, 2) * (width, height)
    arrays["K"] = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])
    arrays["viewmat"] = np.eye(4)
    arrays["viewmat"][:3, :3] = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    arrays["means"] = (
        arrays["means"] @ arrays["viewmat"][:3, :3]
    )  # means were drawn as the camera sees them
    if not tame:
        _poison(rng, arrays)
    channels = [arrays[f"values{i}"].shape[1] for i in range(count)]
    shapes = [(height, width, c) for c in channels] + [(height, width)] * count
    upstream = [rng.standard_normal(shape) for shape in shapes]
    if not tame and rng.random() < 0.1:
        picked = upstream[int(rng.integers(len(upstream)))]
        picked.flat[int(rng.integers(picked.size))] = rng.choice(POISON)
    dtype = torch.float32 if rng.integers(2) else torch.float64
    with np.errstate(over="ignore"):
        tensors = {name: torch.from_numpy(a).to(dtype) for name, a in arrays.items()}
    return FuzzScene(
        tensors, chain_of, shape_of, tuple(bool(rng.integers(4)) for _ in range(count)), width, height,
        _config(rng, tame), tuple(torch.from_numpy(u).to(dtype) for u in upstream),
        asked=tuple(name for name in arrays if name not in ("viewmat", "K") and rng.integers(2)),
        used=tuple(np.flatnonzero(rng.integers(2, size=2 * count)).tolist()) or (0,),
        threads=int(rng.choice([1, 1, 1, 2, 3])), tame=tame,
    )  # fmt: skip


def _shape_of(rng: np.random.Generator, count: int) -> tuple[int | None, ...]:
    """No group has a shape of its own in half of the scenes, some share one in others."""
    if rng.integers(2):
        return (None,) * count
    drawn = [int(rng.integers(-1, 2)) for _ in range(count)]
    return tuple(None if shape < 0 else shape for shape in drawn)


def _arrays(
    rng: np.random.Generator,
    n: int,
    tame: bool,
    chain_of: tuple[int, ...],
    shape_of: tuple[int | None, ...],
) -> dict[str, np.ndarray]:
    arrays = {
        "means": _means(rng, n, tame),
        "quats": _quats(rng, n),
        "scales": np.exp(_log_scales(rng, n)),
    }
    for shape in sorted({shape for shape in shape_of if shape is not None}):
        arrays[f"shape{shape}.quats"] = _quats(rng, n)
        arrays[f"shape{shape}.scales"] = np.exp(_log_scales(rng, n))
    for chain in sorted(set(chain_of)):
        arrays[f"weight{chain}"] = _weights(rng, n)
    narrow = rng.integers(2)
    for i in range(len(chain_of)):
        channels = 3 if narrow else int(rng.integers(1, 41))
        power = rng.uniform(-38, 38) if not tame and rng.random() < 0.2 else 0.0
        arrays[f"values{i}"] = rng.standard_normal((n, channels)) * 10.0**power
    return arrays


def _means(rng: np.random.Generator, n: int, tame: bool) -> np.ndarray:
    """In front, behind, on the near plane, far off the axis; as the camera sees them."""
    means = rng.standard_normal((n, 3)) * (1.2, 1.0, 1.0) + (0, 0, 2.5)
    kind = rng.integers(0, 8, n)
    means[kind == 0, 2] *= -1
    means[kind == 1, 2] = rng.choice([0.01 * (1 - 1e-6), 0.01, 0.01 * (1 + 1e-6), 0.011, 0.05])
    means[kind == 2, 0] *= rng.uniform(1, 1e3)
    means[kind == 3, 2] = 2.0  # ties
    if not tame:
        means[kind == 4] *= 10.0 ** rng.uniform(-30, 30)
    return means


def _quats(rng: np.random.Generator, n: int) -> np.ndarray:
    quats = rng.standard_normal((n, 4))
    return quats * rng.choice([1.0, 1.0, -1.0, 0.0, 1e-20, 1e20, 1e-3], (n, 1))


def _log_scales(rng: np.random.Generator, n: int) -> np.ndarray:
    ordinary = rng.standard_normal((n, 3)) - 2.5
    return np.where(rng.random((n, 1)) < 0.3, rng.uniform(-25, 15, (n, 3)), ordinary)


def _weights(rng: np.random.Generator, n: int) -> np.ndarray:
    """Random, at the edges, or all too faint to be seen."""
    kind = rng.integers(4)
    if kind == 0:
        return rng.choice(WEIGHTS, n)
    return rng.random(n) * (1 / 256 if kind == 1 and rng.random() < 0.3 else 1.0)


def _config(rng: np.random.Generator, tame: bool) -> RasterConfig:
    return RasterConfig(
        near=float(rng.choice([0.01, 0.2, 1e-6])),
        eps2d=float(rng.choice([0.3, 1e-4])),
        alpha_min=float(rng.choice([1 / 255, 1e-6, 0.1])),
        alpha_max=float(rng.choice([0.99, 0.999, 0.5])),
        transmittance_min=float(rng.choice([1e-4, 0.0, 0.3])),
        stop="before" if rng.integers(2) else "after",
        fov_margin=float(rng.choice([0.3, 0.0, 10.0])),
        memory_budget=2 << 30 if tame or rng.random() < 0.95 else 4096,
        **{switch: bool(rng.integers(4)) for switch in SWITCHES},
        near_sigmas=float(rng.choice([0.0, 1.0, 1e-6])),
    )


def _poison(rng: np.random.Generator, arrays: dict[str, np.ndarray]) -> None:
    for _ in range(int(rng.integers(0, 4))):
        picked = arrays[str(rng.choice(list(arrays)))]
        if picked.size:
            picked.flat[int(rng.integers(picked.size))] = rng.choice(POISON)
