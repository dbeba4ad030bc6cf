"""Images and gradients that a rasterizer computed, and their errors against the truth."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from vlgs.bench.clock import Pass, time_pass
from vlgs.bench.scenes import LEAVES
from vlgs.bench.workload import Workload
from vlgs.ops.rasterize import rasterize
from vlgs.types import RasterConfig

SMALLEST_ALPHA = 1e-15
"""Stands for no cut-off: a million Gaussians of which each leaves out less than this are off by less than 1e-9."""


@dataclass(frozen=True)
class RasterOutcome:
    """Images and the gradients of all leaves, float64 copies."""

    images: tuple[Tensor, ...]
    gradients: Mapping[str, Tensor]


@dataclass(frozen=True)
class Errors:
    """Distance of an outcome from the truth. Image values are of the order of 1 (colour) and 1/sqrt(d) (language)."""

    image_max: float
    """Largest absolute error over all pixels and channels of both images."""
    image_mean: float
    """Mean absolute error over the same."""
    l2: Mapping[str, float]
    """|g - g_true| / |g_true| per leaf."""
    cos: Mapping[str, float]
    """Cosine between g and g_true per leaf."""

    @property
    def gradient(self) -> float:
        """The worst of the relative errors."""
        return max(self.l2.values())


def without_cutoffs(config: RasterConfig) -> RasterConfig:
    """The same camera model with nothing skipped, stopped or clamped, as far as the configuration allows (for float64)."""
    return replace(
        config, alpha_min=SMALLEST_ALPHA, alpha_max=1 - 1e-12, transmittance_min=0.0, stop="after"
    )


def render(
    w: Workload, config: RasterConfig, backend: Literal["cpu", "reference"] = "cpu"
) -> tuple[Tensor, ...]:
    """Both images of a workload."""
    c = w.camera
    size = (c.width, c.height)
    return rasterize(
        w.means, w.quats, w.scales, w.groups, c.viewmat.to(w.means.dtype), c.K, *size,
        config=config, backend=backend,
    ).images  # fmt: skip


def time_render(w: Workload, config: RasterConfig, threads: int) -> Pass:
    """One forward and backward pass on so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return time_pass(partial(render, w, config), w.upstream, w.leaves())
    finally:
        torch.set_num_threads(before)


def outcome(
    w: Workload, config: RasterConfig, backend: Literal["cpu", "reference"] = "cpu"
) -> RasterOutcome:
    """Images and gradients of a workload in its own precision."""
    images = render(w, config, backend)
    gradients = torch.autograd.grad(images, w.leaves(), w.upstream)
    return RasterOutcome(
        tuple(image.detach().double() for image in images),
        {name: g.double() for name, g in zip(LEAVES, gradients, strict=True)},
    )


def compare(got: RasterOutcome, true: RasterOutcome) -> Errors:
    """How far one outcome is from another. A gradient that is zero in truth has error 0 if it is zero, else infinity."""
    differences = torch.cat(
        [(a - b).abs().flatten() for a, b in zip(got.images, true.images, strict=True)]
    )
    l2, cos = {}, {}
    for name, b in true.gradients.items():
        a = got.gradients[name]
        distance, length = float((a - b).norm()), float(b.norm())
        l2[name] = distance / length if length else (0.0 if distance == 0 else float("inf"))
        both = float(a.norm()) * length
        cos[name] = float((a * b).sum()) / both if both else float(distance == 0)
    return Errors(float(differences.max()), float(differences.mean()), l2, cos)


def largest_value(w: Workload) -> float:
    """Largest absolute value that is blended; bounds on images scale with it."""
    return max(float(group.values.detach().abs().max()) for group in w.groups)
