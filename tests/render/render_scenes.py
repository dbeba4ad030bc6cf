"""Scenes for the rasterizer's tests, and one way to render and differentiate them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.ops import rasterize_reference as reference
from vlgs.ops.rasterize import rasterize
from vlgs.types import Camera, ChannelGroup, RasterConfig, Rendered

WIDTH, HEIGHT = 37, 29  # odd, unequal, and neither a multiple of a block nor of a tile


@dataclass(frozen=True)
class RenderScene:
    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    weights: tuple[Float[Tensor, " n"], ...]
    """One per group; groups share a chain where this holds one tensor twice."""
    values: tuple[Float[Tensor, "n _"], ...]
    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int = WIDTH
    height: int = HEIGHT
    shape_grads: tuple[bool, ...] = (True,) * 8

    def to(self, dtype: torch.dtype) -> "RenderScene":
        weights = {id(w): w.to(dtype) for w in self.weights}
        return replace(
            self,
            means=self.means.to(dtype),
            quats=self.quats.to(dtype),
            scales=self.scales.to(dtype),
            weights=tuple(weights[id(w)] for w in self.weights),
            values=tuple(v.to(dtype) for v in self.values),
        )


def camera_at_origin(width: int = WIDTH, height: int = HEIGHT) -> tuple[Tensor, Tensor]:
    """A camera whose principal point is off centre."""
    K = torch.tensor([[30.0, 0, 0.45 * width], [0, 33.0, 0.55 * height], [0, 0, 1]]).double()
    return torch.eye(4).double(), K


def random_splats(
    n: int, seed: int, channels: Sequence[int] = (3, 3), spread: float = 0.8
) -> RenderScene:
    """Gaussians in front of, around and a few behind a turned camera; float64 numbers that float32 holds exactly."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng).double()

    viewmat, K = camera_at_origin()
    viewmat[:3, :3] = torch.linalg.qr(normal(3, 3))[0].float().double()
    viewmat[:3, 3] = (0.1 * normal(3)).float().double()
    in_camera = normal(n, 3) * torch.tensor([1.2, 0.9, 1.0]) + torch.tensor([0.0, 0.0, 2.5])
    means = (in_camera - viewmat[:3, 3]) @ viewmat[:3, :3]
    scales = torch.exp(spread * normal(n, 3) - 2)
    splats = RenderScene(
        means, normal(n, 4), scales,
        tuple(torch.rand(n, generator=rng).double() for _ in channels),
        tuple(normal(n, c) for c in channels),
        viewmat, K,
    )  # fmt: skip
    return splats.to(torch.float32).to(torch.float64)


def render(
    splats: RenderScene, backend: str = "cpu", config: RasterConfig | None = None
) -> tuple[Rendered, dict[str, Tensor]]:
    """Render with leaves that require gradients; returns the leaves by name."""
    leaves = {name: getattr(splats, name) for name in ("means", "quats", "scales")}
    chains = {id(w): f"weight{i}" for i, w in enumerate(splats.weights)}
    leaves |= {chains[id(w)]: w for w in splats.weights}
    leaves |= {f"values{i}": v for i, v in enumerate(splats.values)}
    leaves = {name: leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
    groups = [
        ChannelGroup(leaves[f"values{i}"], leaves[chains[id(w)]], splats.shape_grads[i])
        for i, w in enumerate(splats.weights)
    ]
    out = rasterize(
        leaves["means"], leaves["quats"], leaves["scales"], groups, splats.viewmat, splats.K,
        splats.width, splats.height, config or RasterConfig(), backend,  # pyright: ignore[reportArgumentType]
    )  # fmt: skip
    return out, leaves


def render_with_gradients(
    splats: RenderScene,
    backend: str = "cpu",
    config: RasterConfig | None = None,
    weight: Tensor | float = 1.0,
) -> tuple[Rendered, dict[str, Tensor]]:
    """Images and the gradients of a random linear function of all images and alphas, times `weight` per pixel."""
    out, leaves = render(splats, backend, config)
    leaves["mean2d"] = out.mean2d
    rng = torch.Generator().manual_seed(99)
    pixels = [*out.images, *(a[..., None] for a in out.alphas)]
    upstream = [torch.randn(p.shape, generator=rng).double() for p in pixels]
    mask = weight[..., None] if isinstance(weight, Tensor) else weight
    loss = sum(((d * mask).to(p) * p).sum() for d, p in zip(upstream, pixels, strict=True))
    assert isinstance(loss, Tensor)
    grads = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    zeros = (torch.zeros_like(leaf) for leaf in leaves.values())
    return out, {
        name: zero if grad is None else grad
        for (name, _), grad, zero in zip(leaves.items(), grads, zeros, strict=True)
    }


def sure_pixels(splats: RenderScene, config: RasterConfig, band: float) -> Bool[Tensor, "h w"]:
    """Pixels where no Gaussian of any group lies within a relative `band` of a cutoff, a clamp or a stop.

    There the image model jumps, so that rounding may decide either way.
    """
    camera = Camera(splats.viewmat, splats.K, splats.width, splats.height)
    flat = reference._project(splats.means, splats.quats, splats.scales, camera, config)
    order = torch.argsort(flat.depth, stable=True)
    order = order[flat.in_front[order]]
    falloff = torch.exp(-reference._exponent(flat, order, splats.width, splats.height))
    unsure = torch.zeros(splats.height * splats.width, dtype=torch.bool)

    def near(x: Tensor, value: float) -> Tensor:
        return ((x - value).abs() < band * value).any(0)

    for weight in splats.weights:
        raw = weight[order, None] * falloff
        alpha = torch.where(raw >= config.alpha_min, raw.clamp(max=config.alpha_max), 0)
        unsure |= near(raw, config.alpha_min) | near(raw, config.alpha_max)
        unsure |= near(torch.cumprod(1 - alpha, 0), config.transmittance_min)
    return ~unsure.unflatten(0, (splats.height, splats.width))


def relative_error(got: Tensor, want: Tensor) -> float:
    return ((got - want).norm() / want.norm().clamp_min(1e-12)).item()
