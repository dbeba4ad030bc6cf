"""Scenes for the stress cases: one camera, groups of channels, and gradients of everything."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.ops.rasterize import rasterize
from vlgs.types import ChannelGroup, RasterConfig, Rendered

SMOOTH = RasterConfig(alpha_min=1e-12, transmittance_min=0.0)
"""Without steps that rounding decides: cutoffs so low that what they drop cannot be seen."""


@dataclass(frozen=True)
class StressScene:
    """Gaussians before a camera that stands at the origin and looks along z."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    weights: tuple[Float[Tensor, " n"], ...]
    values: tuple[Float[Tensor, "n _"], ...]
    width: int
    height: int
    focal: float
    center: tuple[float, float] | None = None
    """Principal point in pixels; the middle of the image where it is None."""

    def to(self, dtype: torch.dtype) -> "StressScene":
        """The same numbers, rounded."""
        return replace(
            self, means=self.means.to(dtype), quats=self.quats.to(dtype), scales=self.scales.to(dtype),
            weights=tuple(w.to(dtype) for w in self.weights),
            values=tuple(v.to(dtype) for v in self.values),
        )  # fmt: skip

    def rows(self, index: Tensor) -> "StressScene":
        """Some of the Gaussians."""
        return replace(
            self, means=self.means[index], quats=self.quats[index], scales=self.scales[index],
            weights=tuple(w[index] for w in self.weights),
            values=tuple(v[index] for v in self.values),
        )  # fmt: skip


def make_splats(
    n: int, seed: int = 0, size: tuple[int, int] = (61, 45), channels: Sequence[int] = (3, 3)
) -> StressScene:
    """Ordinary Gaussians at depths 2 to 6, all different in float32 too, a few of them beyond the edges of the image."""
    rng = torch.Generator().manual_seed(seed)
    width, height = size
    focal = 0.9 * width
    depth = 2 + 4 * torch.randperm(n, generator=rng) / max(n, 1)
    screen = torch.rand(n, 2, generator=rng) * 1.1 - 0.05
    offset = (screen - 0.5) * torch.tensor([width, height]) / focal
    means = torch.cat([offset * depth[:, None], depth[:, None]], 1)
    scales = torch.exp(0.5 * torch.randn(n, 3, generator=rng) - 2.5)
    quats = torch.randn(n, 4, generator=rng)
    weights = tuple(torch.rand(n, generator=rng) for _ in channels)
    values = tuple(torch.randn(n, c, generator=rng) for c in channels)
    return StressScene(means, quats, scales, weights, values, width, height, focal)


def full_screen(n: int, size: tuple[int, int], channels: int = 1) -> StressScene:
    """Gaussians whose every pixel is within a hundredth of a deviation, at depths 2 to 3."""
    width, height = size
    depth = 2 + torch.arange(n) / max(n, 1)
    means = torch.stack([torch.zeros(n), torch.zeros(n), depth], 1)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(n, 4)
    return StressScene(
        means, quats, torch.full((n, 3), 1e3), (torch.full((n,), 0.5),),
        (torch.ones(n, channels),), width, height, 0.9 * width,
    )  # fmt: skip


def render(
    splats: StressScene, backend: str = "cpu", config: RasterConfig | None = None
) -> tuple[Rendered, dict[str, Tensor]]:
    """Images, and the leaves they depend on by name."""
    leaves = {"means": splats.means, "quats": splats.quats, "scales": splats.scales}
    leaves |= {f"weight{i}": w for i, w in enumerate(splats.weights)}
    leaves |= {f"values{i}": v for i, v in enumerate(splats.values)}
    leaves = {name: leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
    groups = [
        ChannelGroup(leaves[f"values{i}"], leaves[f"weight{i}"]) for i in range(len(splats.weights))
    ]
    cx, cy = splats.center or (splats.width / 2, splats.height / 2)
    K = torch.tensor([[splats.focal, 0, cx], [0, splats.focal, cy], [0, 0, 1]], dtype=torch.float64)
    out = rasterize(
        leaves["means"], leaves["quats"], leaves["scales"], groups, torch.eye(4), K,
        splats.width, splats.height, config or RasterConfig(), backend,  # pyright: ignore[reportArgumentType]
    )  # fmt: skip
    return out, leaves


def render_with_gradients(
    splats: StressScene, backend: str = "cpu", config: RasterConfig | None = None
) -> tuple[Rendered, dict[str, Tensor]]:
    """Images, and the gradients of a fixed random linear function of all images and alphas."""
    out, leaves = render(splats, backend, config)
    rng = torch.Generator().manual_seed(99)
    pictures = [*out.images, *out.alphas]
    upstream = [torch.randn(p.shape, generator=rng).to(p) for p in pictures]
    grads = torch.autograd.grad(pictures, list(leaves.values()), upstream, allow_unused=True)
    named = zip(leaves.items(), grads, strict=True)
    return out, {name: torch.zeros_like(leaf) if g is None else g for (name, leaf), g in named}


def tensors_of(out: Rendered, grads: dict[str, Tensor]) -> list[Tensor]:
    """Everything that came out, to be compared to the bit."""
    return [*out.images, *out.alphas, out.visible, out.mean2d, *grads.values()]


def same_bits(a: list[Tensor], b: list[Tensor]) -> bool:
    """Whether all tensors are equal."""
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def half_turn(n: int, angle: float) -> Float[Tensor, "n 4"]:
    """Quaternions of a turn about the line of sight."""
    return torch.tensor([math.cos(angle / 2), 0, 0, math.sin(angle / 2)]).expand(n, 4)
