"""Ellipses to images, front to back: the second half of rasterizing."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.arrays import array_list, arrays
from vlgs.ops.device import Kernels, differentiated
from vlgs.ops.project import Splats
from vlgs.types import Camera, ChannelGroup, RasterConfig, Rendered


def rasterize_to_pixels(
    splats: Splats, groups: Sequence[ChannelGroup], camera: Camera, config: RasterConfig
) -> Rendered:
    """Every group's values blended with its weights, on checked input; `vlgs.ops.rasterize_reference` defines it."""
    return KERNELS.of(splats.depth)(splats, groups, camera, config)


class RasterizeWork(NamedTuple):
    """The amount of work of a forward pass."""

    entries: int
    """Of all tile lists: (Gaussian, tile) pairs."""
    weighed: int
    """(Gaussian, 4x4 block of pixels, chain of transmittance) triples whose weights were formed."""


def count_work(
    splats: Splats, groups: Sequence[ChannelGroup], camera: Camera, config: RasterConfig
) -> RasterizeWork:
    """Blend once more, on the CPU, and count; for benchmarks.

    Raises:
        ValueError: With ``stop="before"``, which leaves no trace of where a block ended.
    """
    layout, weights = _lay_out(groups, camera, config)
    values = [groups[i].values for i in layout.order]
    with torch.no_grad():
        return RasterizeWork(*_rasterize(layout, True, *splats, *weights, *values)[0].work())


def weights_alone(
    splats: Splats, weight: Tensor, camera: Camera, config: RasterConfig
) -> tuple[_csrc.RasterizedFloat | _csrc.RasterizedDouble, Tensor, Tensor]:
    """A picture of nothing but weights, as the CPU's kernel holds it, with `visible` and the accumulated weight."""
    nothing = ChannelGroup(weight.new_zeros(len(weight), 1), weight)
    layout, weights = _lay_out([nothing], camera, config)
    picture, (visible, alpha, _) = _rasterize(layout, True, *splats, *weights, nothing.values)
    return picture, visible, alpha


class _Layout(NamedTuple):
    """Which group uses which chain of transmittance, and which of them need gradients."""

    width: int
    height: int
    config: _csrc.RasterizeConfig
    shape_grads: list[bool]
    """Per chain."""
    order: list[int]
    """Groups in the order of their chains."""
    chain_of: list[int]
    """Chain of each of `order`."""


def _lay_out(
    groups: Sequence[ChannelGroup], camera: Camera, config: RasterConfig
) -> tuple[_Layout, list[Tensor]]:
    """Groups with the very same weight tensor share a chain; returns the weights, one per chain."""
    share = config.share_chains
    names = [(id(g.weight) if share else i, g.shape_grad) for i, g in enumerate(groups)]
    chains: dict[tuple[int, bool], int] = {}
    chain_of = [chains.setdefault(name, len(chains)) for name in names]
    order = sorted(range(len(groups)), key=chain_of.__getitem__)
    weights = [groups[chain_of.index(c)].weight for c in range(len(chains))]
    shape_grads = [shape_grad for _, shape_grad in chains]
    layout = _Layout(
        camera.width, camera.height, _kernel_config(config),
        shape_grads, order, [chain_of[i] for i in order],
    )  # fmt: skip
    return layout, weights


@lru_cache(maxsize=64)
def _kernel_config(config: RasterConfig) -> _csrc.RasterizeConfig:
    return _csrc.RasterizeConfig(
        config.alpha_min,
        config.alpha_max,
        config.transmittance_min,
        config.stop == "before",
        config.memory_budget,
        config.tile_test,
        config.block_masks,
        config.opacity_extent,
    )


def _rasterize(layout: _Layout, keep: bool, *tensors: Tensor):
    """The kernel's object and the outputs of `_RasterizeToPixels`; nothing is kept for a backward pass unless asked for."""
    mean2d, ellipse, depth, *rest = [t.contiguous() for t in tensors]
    num_chains = len(layout.shape_grads)
    weights, values = rest[:num_chains], rest[num_chains:]
    size = (layout.height, layout.width)
    visible = torch.empty(len(depth), dtype=torch.bool)
    alphas = [depth.new_empty(size) for _ in weights]
    images = [depth.new_empty(*size, v.shape[1]) for v in values]
    kernel = _csrc.RasterizedFloat if depth.dtype == torch.float32 else _csrc.RasterizedDouble
    picture = kernel(
        *arrays(mean2d, ellipse, depth), array_list(weights), layout.shape_grads, array_list(values), layout.order,
        layout.chain_of, layout.config, array_list(images), array_list(alphas), *arrays(visible), keep, torch.get_num_threads(),
    )  # fmt: skip
    return picture, (visible, *alphas, *images)


class _RasterizeToPixels(torch.autograd.Function):
    """Splats, one weight per chain and the values of every group to (visible, alpha per chain, image per group)."""

    @staticmethod
    def forward(ctx: Any, layout: _Layout, *tensors: Tensor):
        tensors = tuple(t.contiguous() for t in tensors)
        ctx.picture, outputs = _rasterize(layout, True, *tensors)
        mean2d, ellipse, _, *rest = tensors
        ctx.save_for_backward(mean2d, ellipse, *rest)
        ctx.num_chains = len(layout.shape_grads)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(outputs[0])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        saved = ctx.saved_tensors
        num_chains = ctx.num_chains
        # None for a picture that the loss did not use; the first output is `visible`.
        d_pictures = [None if d is None else d.contiguous() for d in grad_outputs[1:]]
        # None for an input that needs no gradient; depth, the fourth input, never does.
        _, needs_mean2d, needs_ellipse, _, *needs_rest = ctx.needs_input_grad
        needs = (needs_mean2d, needs_ellipse, *needs_rest)
        grads = [torch.empty_like(t) if n else None for t, n in zip(saved, needs, strict=True)]
        d_mean2d, d_ellipse, *d_rest = grads
        values, d_images = saved[2 + num_chains :], d_pictures[num_chains:]
        ctx.picture.backward(
            array_list(values), array_list(d_images), array_list(d_pictures[:num_chains]),
            *arrays(d_mean2d, d_ellipse), array_list(d_rest[:num_chains]), array_list(d_rest[num_chains:]), torch.get_num_threads(),
        )  # fmt: skip
        return (None, d_mean2d, d_ellipse, None, *d_rest)


def _on_cpu(
    splats: Splats, groups: Sequence[ChannelGroup], camera: Camera, config: RasterConfig
) -> Rendered:
    layout, weights = _lay_out(groups, camera, config)
    values = [groups[i].values for i in layout.order]
    tensors = (*splats, *weights, *values)
    if differentiated(tensors):
        visible, *pictures = _RasterizeToPixels.apply(layout, *tensors)
    else:
        visible, *pictures = _rasterize(layout, False, *tensors)[1]
    images: list[Tensor] = [visible] * len(groups)
    alphas = list(images)
    for image, i, chain in zip(
        pictures[len(weights) :], layout.order, layout.chain_of, strict=True
    ):
        images[i], alphas[i] = image, pictures[chain]
    return Rendered(tuple(images), tuple(alphas), visible, splats.mean2d)


KERNELS = Kernels("rasterize_to_pixels", cpu=_on_cpu)
