"""Random hostile scenes through the rasterizer and back: finite numbers or a named error, nothing else (pitfalls N2).

With each scene go random calls of the other kernels (`vlgs.bench.fuzz_layers`). A scene is a function of its seed alone, so that `python -m vlgs.bench fuzz --first SEED --scenes 1` runs a failure again. Half of
the scenes are tame: every number is one that training can reach, and refusing such a scene is a failure too.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from vlgs.bench.fuzz_layers import run_frozen, run_layers
from vlgs.render import rasterize
from vlgs.types import ChannelGroup, RasterConfig

POISON = (
    np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, -5e-324, 1e-45, 1e-40, -1e-40, 1.1754944e-38, 1e-38,
    -1e-38, 1e38, -1e38, 3.4028235e38, 1e300, -1e300, 1e-20, 1e20, 1 / 255, 0.99, 1.0, -1.0, 16.0,
)  # fmt: skip
"""What is strewn into any input."""

_ULP = 2.0**-24
WEIGHTS = (0.0, 1e-7, 1 / 255 * (1 - _ULP), 1 / 255, 1 / 255 * (1 + 2 * _ULP),
           0.99 * (1 - _ULP), 0.99, 0.99 * (1 + 2 * _ULP), 1.0)  # fmt: skip
"""Weights at the edges of the image model, an ulp of float32 to either side."""

NAMED = re.compile(r"^[A-Za-z]\w*: .+ must be .+, got ", re.DOTALL)
"""``<who>: <what> must be <expected>, got <actual>``."""


@dataclass(frozen=True)
class FuzzScene:
    """Input of one call, as leaves."""

    tensors: dict[str, Tensor]
    """means, quats, scales, weight0.., values0.., viewmat, K."""
    chain_of: tuple[int, ...]
    """Weight of each group."""
    shape_grads: tuple[bool, ...]
    width: int
    height: int
    config: RasterConfig
    upstream: tuple[Tensor, ...]
    """Gradients of images, then of alphas."""
    tame: bool


@dataclass
class FuzzReport:
    """What became of the scenes."""

    finite: int = 0
    refused: int = 0
    """Scenes that ended in a named error."""
    failures: dict[int, str] = field(default_factory=dict)
    """Seed -> what is wrong."""

    def __str__(self) -> str:
        wrong = "".join(f"\n  seed {seed}: {what}" for seed, what in self.failures.items())
        return f"{self.finite} finite, {self.refused} refused by name, {len(self.failures)} failed{wrong}"


def make_scene(seed: int) -> FuzzScene:
    """The scene of a seed: up to 200 Gaussians, images up to 69 pixels wide, 1 to 5 groups of 1 to 40 channels."""
    rng = np.random.default_rng(seed)
    tame = bool(rng.integers(2))
    n = int(rng.choice([0, 1, 2, 7, 40, int(rng.integers(201))]))
    width, height = (int(rng.choice([1, 16, 17, int(rng.integers(1, 70))])) for _ in range(2))
    count = int(rng.integers(1, 6))
    chain_of = tuple(int(rng.integers(i + 1)) for i in range(count))
    arrays = {
        "means": _means(rng, n, tame),
        "quats": _quats(rng, n),
        "scales": np.exp(_log_scales(rng, n)),
    }
    for chain in sorted(set(chain_of)):
        arrays[f"weight{chain}"] = _weights(rng, n)
    for i in range(count):
        power = rng.uniform(-38, 38) if not tame and rng.random() < 0.2 else 0.0
        arrays[f"values{i}"] = rng.standard_normal((n, int(rng.integers(1, 41)))) * 10.0**power
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
        tensors, chain_of, tuple(bool(rng.integers(4)) for _ in range(count)), width, height,
        _config(rng, tame), tuple(torch.from_numpy(u).to(dtype) for u in upstream), tame,
    )  # fmt: skip


def run_scene(scene: FuzzScene) -> str | None:
    """Render and differentiate; returns the message of a named error, or None where all is finite.

    Raises:
        AssertionError: If a result is not finite, has another shape than it should, or a tame scene is refused.
    """
    leaves = {
        name: t.clone().requires_grad_(name not in ("viewmat", "K"))
        for name, t in scene.tensors.items()
    }
    groups = [
        ChannelGroup(leaves[f"values{i}"], leaves[f"weight{chain}"], shape_grad)
        for i, (chain, shape_grad) in enumerate(zip(scene.chain_of, scene.shape_grads, strict=True))
    ]
    try:
        out = rasterize(
            leaves["means"], leaves["quats"], leaves["scales"], groups, leaves["viewmat"], leaves["K"],
            scene.width, scene.height, scene.config,
        )  # fmt: skip
        pictures = [*out.images, *out.alphas]
        torch.autograd.backward(pictures, list(scene.upstream))
    except ValueError as error:
        _require(bool(NAMED.match(str(error))), f"error without a name: {error}")
        _require(not scene.tame, f"a tame scene was refused: {error}")
        return str(error)
    for i, picture in enumerate(pictures):
        _require(bool(picture.isfinite().all()), f"picture {i} is not finite")
    _require(bool(out.mean2d.isfinite().all()), "mean2d is not finite")
    for name, leaf in leaves.items():
        if leaf.requires_grad:
            assert leaf.grad is not None
            _require(
                leaf.grad.shape == leaf.shape, f"gradient of {name} has shape {leaf.grad.shape}"
            )
            _require(bool(leaf.grad.isfinite().all()), f"gradient of {name} is not finite")
    # A frozen view also refuses values of Gaussians out of sight, which the rasterizer never reads.
    if scene.tensors["values0"].isfinite().all():
        run_frozen(scene.tensors, scene.width, scene.height, scene.config, out.images[0].detach())
    return None


def fuzz(seeds: Iterable[int], verbose: bool = False) -> FuzzReport:
    """Run the scenes of some seeds; any exception of a scene is a failure of its seed.

    Args:
        seeds: One scene each.
        verbose: Whether seeds are announced on standard output before they run, for a process that may be ended by one.
    """
    report = FuzzReport()
    for seed in seeds:
        if verbose:
            print(f"\rseed {seed}", end=" ", flush=True)
        try:
            refused = run_scene(make_scene(seed))
            run_layers(seed, POISON)
        except Exception as error:
            report.failures[seed] = f"{type(error).__name__}: {error}"
            continue
        report.finite += refused is None
        report.refused += refused is not None
    return report


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise AssertionError(otherwise)


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
    )


def _poison(rng: np.random.Generator, arrays: dict[str, np.ndarray]) -> None:
    for _ in range(int(rng.integers(0, 4))):
        picked = arrays[str(rng.choice(list(arrays)))]
        if picked.size:
            picked.flat[int(rng.integers(picked.size))] = rng.choice(POISON)
