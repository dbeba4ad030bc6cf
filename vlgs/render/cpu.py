"""The kernel in `csrc` as two autograd functions: projection, which gives `mean2d`, and blending."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs import _csrc
from vlgs.types import Camera, ChannelGroup, RasterConfig, Rendered, Shape


class Splats(NamedTuple):
    """Gaussians on the image plane, as csrc/kernels.h describes them."""

    mean2d: Float[Tensor, "n 2"]
    """Pixels; 0 where culled."""
    ellipse: Float[Tensor, "n 3"]
    """1 / deviation of x given y, slope of x over y, 1 / deviation of y."""
    depth: Float[Tensor, " n"]
    """World units; 0 marks a culled Gaussian. Carries no gradient."""


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    groups: Sequence[ChannelGroup],
    camera: Camera,
    config: RasterConfig,
) -> Rendered:
    """`vlgs.rasterize` on checked input."""
    splats = project(means, quats, scales, camera, config)
    if all(group.shape is None for group in groups):
        return blend(splats, groups, camera, config)
    images: list[Tensor] = [splats.mean2d] * len(groups)
    alphas, visible = list(images), torch.zeros(len(means), dtype=torch.bool)
    by_shape: dict[int, list[int]] = {}
    for index, group in enumerate(groups):
        by_shape.setdefault(id(group.shape), []).append(index)
    for indices in by_shape.values():
        own = _reshaped(splats, means, groups[indices[0]].shape, camera, config)
        part = blend(own, [groups[i] for i in indices], camera, config)
        for index, image, alpha in zip(indices, part.images, part.alphas, strict=True):
            images[index], alphas[index] = image, alpha
        visible |= part.visible
    return Rendered(tuple(images), tuple(alphas), visible, splats.mean2d)


def _reshaped(
    splats: Splats,
    means: Float[Tensor, "n 3"],
    shape: Shape | None,
    camera: Camera,
    config: RasterConfig,
) -> Splats:
    """The same Gaussians with another covariance; centres stay one tensor, which gathers the gradients of all shapes."""
    if shape is None:
        return splats
    try:
        own = project(means, shape.quats, shape.scales, camera, config)
    except ValueError as error:
        raise ValueError(f"{error} of a group's own shape") from error
    depth = torch.where(splats.depth > 0, own.depth, 0.0)
    return Splats(splats.mean2d, own.ellipse, depth)


def project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    camera: Camera,
    config: RasterConfig,
) -> Splats:
    """The first of the two autograd functions."""
    tensors = means, quats, scales
    if not _differentiated(tensors):
        return Splats(*_project(*tensors, _kernel_camera(camera, config)))
    return Splats(*_Project.apply(*tensors, _kernel_camera(camera, config)))


def blend(
    splats: Splats, groups: Sequence[ChannelGroup], camera: Camera, config: RasterConfig
) -> Rendered:
    """The second of the two autograd functions."""
    layout, weights = _lay_out(groups, camera, config)
    values = [groups[i].values for i in layout.order]
    tensors = (*splats, *weights, *values)
    if _differentiated(tensors):
        visible, *pictures = _Blend.apply(layout, *tensors)
    else:
        visible, *pictures = _blend(layout, False, *tensors)[1]
    images: list[Tensor] = [visible] * len(groups)
    alphas = list(images)
    for image, i, chain in zip(
        pictures[len(weights) :], layout.order, layout.chain_of, strict=True
    ):
        images[i], alphas[i] = image, pictures[chain]
    return Rendered(tuple(images), tuple(alphas), visible, splats.mean2d)


def _differentiated(tensors: Sequence[Tensor]) -> bool:
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors)


class _Layout(NamedTuple):
    """Which group uses which chain of transmittance, and which of them need gradients."""

    width: int
    height: int
    config: _csrc.BlendConfig
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
def _kernel_config(config: RasterConfig) -> _csrc.BlendConfig:
    return _csrc.BlendConfig(
        config.alpha_min,
        config.alpha_max,
        config.transmittance_min,
        config.stop == "before",
        config.memory_budget,
        config.tile_test,
        config.block_masks,
        config.opacity_extent,
    )


def _kernel_camera(camera: Camera, config: RasterConfig) -> _csrc.Camera:
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    x, y = config.fov_margin * camera.width / 2, config.fov_margin * camera.height / 2
    slopes = [
        -(cx + x) / fx, (camera.width - cx + x) / fx,
        -(cy + y) / fy, (camera.height - cy + y) / fy,
    ]  # fmt: skip
    viewmat = camera.viewmat.flatten().tolist()
    return _csrc.Camera(viewmat, [fx, fy, cx, cy], slopes, config.near, config.eps2d)


class Work(NamedTuple):
    """The amount of work of a forward pass."""

    entries: int
    """Of all tile lists: (Gaussian, tile) pairs."""
    weighed: int
    """(Gaussian, 4x4 block of pixels, chain of transmittance) triples whose weights were formed."""


def count_work(
    splats: Splats, groups: Sequence[ChannelGroup], camera: Camera, config: RasterConfig
) -> Work:
    """Blend once more and count; for benchmarks.

    Raises:
        ValueError: With ``stop="before"``, which leaves no trace of where a block ended.
    """
    layout, weights = _lay_out(groups, camera, config)
    values = [groups[i].values for i in layout.order]
    with torch.no_grad():
        return Work(*_blend(layout, True, *splats, *weights, *values)[0].work())


def freeze(
    splats: Splats, weight: Tensor, camera: Camera, config: RasterConfig
) -> tuple[_csrc.BlendFloat | _csrc.BlendDouble, Tensor, Tensor]:
    """A picture of nothing but weights, as the kernel holds it, with `visible` and the accumulated weight."""
    nothing = ChannelGroup(weight.new_zeros(len(weight), 1), weight)
    layout, weights = _lay_out([nothing], camera, config)
    picture, (visible, alpha, _) = _blend(layout, True, *splats, *weights, nothing.values)
    return picture, visible, alpha


def _project(means: Tensor, quats: Tensor, scales: Tensor, camera: _csrc.Camera):
    """The fields of `Splats`."""
    mean2d, ellipse = means.new_empty(len(means), 2), means.new_empty(len(means), 3)
    depth = means.new_empty(len(means))
    _csrc.project(
        camera, means.contiguous(), quats.contiguous(), scales.contiguous(),
        mean2d, ellipse, depth, torch.get_num_threads(),
    )  # fmt: skip
    return mean2d, ellipse, depth


class _Project(torch.autograd.Function):
    """Gaussians to the fields of `Splats`."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, camera: _csrc.Camera):
        means, quats, scales = means.contiguous(), quats.contiguous(), scales.contiguous()
        mean2d, ellipse, depth = _project(means, quats, scales, camera)
        ctx.save_for_backward(means, quats, scales, depth)
        ctx.camera = camera
        ctx.mark_non_differentiable(depth)
        return mean2d, ellipse, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        means, quats, scales, depth = ctx.saved_tensors
        grads = torch.empty_like(means), torch.empty_like(quats), torch.empty_like(scales)
        upstream = grad_outputs[0].contiguous(), grad_outputs[1].contiguous()
        threads = torch.get_num_threads()
        _csrc.project_backward(ctx.camera, means, quats, scales, depth, *upstream, *grads, threads)
        return (*grads, None)


def _blend(layout: _Layout, keep: bool, *tensors: Tensor):
    """The kernel's object and the outputs of `_Blend`; nothing is kept for a backward pass unless asked for."""
    mean2d, ellipse, depth, *rest = [t.contiguous() for t in tensors]
    num_chains = len(layout.shape_grads)
    weights, values = rest[:num_chains], rest[num_chains:]
    size = (layout.height, layout.width)
    visible = torch.empty(len(depth), dtype=torch.bool)
    alphas = [depth.new_empty(size) for _ in weights]
    images = [depth.new_empty(*size, v.shape[1]) for v in values]
    kernel = _csrc.BlendFloat if depth.dtype == torch.float32 else _csrc.BlendDouble
    blend = kernel(
        mean2d, ellipse, depth, weights, layout.shape_grads, values, layout.order, layout.chain_of,
        layout.config, images, alphas, visible, keep, torch.get_num_threads(),
    )  # fmt: skip
    return blend, (visible, *alphas, *images)


class _Blend(torch.autograd.Function):
    """Splats, one weight per chain and the values of every group to (visible, alpha per chain, image per group)."""

    @staticmethod
    def forward(ctx: Any, layout: _Layout, *tensors: Tensor):
        tensors = tuple(t.contiguous() for t in tensors)
        ctx.blend, outputs = _blend(layout, True, *tensors)
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
        ctx.blend.backward(
            saved[2 + num_chains :], d_pictures[num_chains:], d_pictures[:num_chains],
            d_mean2d, d_ellipse, d_rest[:num_chains], d_rest[num_chains:], torch.get_num_threads(),
        )  # fmt: skip
        return (None, d_mean2d, d_ellipse, None, *d_rest)
