"""Gaussians and a camera in, images out: checks the input and hands it to a backend."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.ops.project import Splats, project
from vlgs.ops.rasterize_to_pixels import rasterize_to_pixels
from vlgs.types import Camera, ChannelGroup, Covariance, RasterConfig, Rendered

DEFAULT = RasterConfig()


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    groups: Sequence[ChannelGroup],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    config: RasterConfig = DEFAULT,
    backend: Literal["cpu", "reference"] = "cpu",
) -> Rendered:
    """Images of 3D Gaussians: every channel group blended front to back with its own weights (Eqs. 1 and 6).

    One depth order and one pass over the image serve all groups; each has its own transmittance, and groups that share one
    weight tensor share one. Where nothing lies, images and accumulated weights are exactly 0. Gradients reach `means`,
    `quats`, `scales` and the values and weights of every group; those of `means`, `quats` and `scales` pass through
    `Rendered.mean2d`, so that ``retain_grad()`` on it gives the gradient in pixels, of all groups together.

    Groups with a `ChannelGroup.shape` are blended in a pass of their own, one per shape.

    A Gaussian is left out, with zero gradient, where it is not beyond `RasterConfig.near` or its quaternion is zero; where
    that of a group's own shape is zero, out of this group. Ties in depth are drawn in the order of the rows.

    Args:
        means: Centres, world units.
        quats: Rotations (w, x, y, z), need not be normalised.
        scales: Standard deviations along the principal axes, world units, >= 0.
        groups: At least one; values are finite, weights in [0, 1].
        viewmat: World to camera; no gradient is formed.
        K: Pinhole intrinsics in pixels, without skew; no gradient is formed.
        width: Pixels.
        height: Pixels.
        config: Constants of the image model.
        backend: ``cpu`` is the kernel, ``reference`` its dense definition, for tests.

    Raises:
        ValueError: If a shape, dtype or value is not as described, if any number is not finite (tensor and row are named), or
            if the tile lists and gradients would not fit `RasterConfig.memory_budget`.

    Example:
        >>> splat = torch.tensor([[0.0, 0.0, 2.0]])
        >>> red = ChannelGroup(torch.tensor([[1.0, 0.0, 0.0]]), weight=torch.tensor([0.5]))
        >>> K = torch.tensor([[9.0, 0.0, 1.5], [0.0, 9.0, 1.5], [0.0, 0.0, 1.0]])
        >>> out = rasterize(splat, torch.eye(4)[:1], torch.full((1, 3), 0.1), [red], torch.eye(4), K, 3, 3)
        >>> out.images[0][1, 1]
        tensor([0.5000, 0.0000, 0.0000])
    """
    check_config(config)
    check_tensors(means, quats, scales, groups)
    camera = Camera(viewmat, K, width, height)
    check_camera(camera)
    if backend == "cpu":
        return _rasterize(means, quats, scales, groups, camera, config)
    if backend == "reference":
        from vlgs.ops import rasterize_reference

        _check_finite(means, quats, scales, groups)
        return rasterize_reference.rasterize(means, quats, scales, groups, camera, config)
    raise ValueError(f"rasterize: backend must be 'cpu' or 'reference', got {backend!r}")


def _rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    groups: Sequence[ChannelGroup],
    camera: Camera,
    config: RasterConfig,
) -> Rendered:
    """Project and blend; groups with a shape of their own in passes of their own."""
    splats = project(means, quats, scales, camera, config)
    if all(group.shape is None for group in groups):
        return rasterize_to_pixels(splats, groups, camera, config)
    images: list[Tensor] = [splats.mean2d] * len(groups)
    alphas, visible = list(images), torch.zeros(len(means), dtype=torch.bool)
    by_shape: dict[int, list[int]] = {}
    for index, group in enumerate(groups):
        by_shape.setdefault(id(group.shape), []).append(index)
    for indices in by_shape.values():
        own = _reshaped(splats, means, groups[indices[0]].shape, camera, config)
        part = rasterize_to_pixels(own, [groups[i] for i in indices], camera, config)
        for index, image, alpha in zip(indices, part.images, part.alphas, strict=True):
            images[index], alphas[index] = image, alpha
        visible |= part.visible
    return Rendered(tuple(images), tuple(alphas), visible, splats.mean2d)


def _reshaped(
    splats: Splats,
    means: Float[Tensor, "n 3"],
    shape: Covariance | None,
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


@lru_cache(maxsize=64)
def check_config(config: RasterConfig) -> None:
    """Refuse constants for which the image is not defined.

    Raises:
        ValueError: Naming the constant.
    """
    rules = {
        "near": (config.near > 0, "> 0"),
        "near_sigmas": (config.near_sigmas >= 0, ">= 0"),
        "eps2d": (config.eps2d > 0, "> 0"),
        # Below 2^-100 the kernel's exponent would leave the range of normal floats.
        "alpha_min": (1e-30 <= config.alpha_min < config.alpha_max, "in [1e-30, alpha_max)"),
        "alpha_max": (config.alpha_max < 1, "below 1"),
        "transmittance_min": (0 <= config.transmittance_min < 1, "in [0, 1)"),
        "stop": (config.stop in ("after", "before"), "'after' or 'before'"),
        "fov_margin": (config.fov_margin >= 0, ">= 0"),
        "memory_budget": (config.memory_budget >= 0, ">= 0"),
    }
    for name, (holds, expected) in rules.items():
        value = getattr(config, name)
        if not holds or (isinstance(value, float) and not math.isfinite(value)):
            raise ValueError(f"RasterConfig: {name} must be {expected}, got {value!r}")


def check_tensors(
    means: Tensor, quats: Tensor, scales: Tensor, groups: Sequence[ChannelGroup]
) -> None:
    """Refuse tensors that do not fit together; their values are looked at where they are read.

    Raises:
        ValueError: Naming the tensor.
    """
    if not groups:
        raise ValueError("rasterize: groups must be at least one ChannelGroup, got none")
    n = means.shape[0] if means.ndim == 2 else -1
    expected: list[tuple[str, Tensor, tuple[int, ...]]]
    expected = [("means", means, (n, 3)), ("quats", quats, (n, 4)), ("scales", scales, (n, 3))]
    for i, group in enumerate(groups):
        channels = group.values.shape[1] if group.values.ndim == 2 else 1
        expected.append((f"groups[{i}].values", group.values, (n, max(channels, 1))))
        expected.append((f"groups[{i}].weight", group.weight, (n,)))
        if group.shape is not None:
            expected.append((f"groups[{i}].shape.quats", group.shape.quats, (n, 4)))
            expected.append((f"groups[{i}].shape.scales", group.shape.scales, (n, 3)))
    for name, tensor, shape in expected:
        if tuple(tensor.shape) != shape:
            raise ValueError(
                f"rasterize: {name} must be of shape {('n', *shape[1:])} with n = {max(n, 0)}, "
                f"got {tuple(tensor.shape)}"
            )
        if tensor.dtype not in (torch.float32, torch.float64) or tensor.dtype != means.dtype:
            raise ValueError(
                f"rasterize: {name} must be float32 or float64 like means ({means.dtype}), got {tensor.dtype}"
            )
        if tensor.device != means.device:
            raise ValueError(
                f"rasterize: {name} must be on the device of means ({means.device}), got {tensor.device}"
            )


def check_camera(camera: Camera) -> None:
    """Refuse a camera that is not a finite pinhole, or from which a gradient is expected.

    Raises:
        ValueError: Naming what is wrong.
    """
    for name, matrix, side in (("viewmat", camera.viewmat, 4), ("K", camera.K, 3)):
        if matrix.shape != (side, side):
            raise ValueError(
                f"rasterize: {name} must be {side} x {side}, got {tuple(matrix.shape)}"
            )
        if matrix.requires_grad:
            raise ValueError(f"rasterize: {name} must be without gradient, got requires_grad=True")
        rows = matrix.tolist()
        if not all(math.isfinite(entry) for row in rows for entry in row):
            raise ValueError(f"rasterize: {name} must be finite, got {rows}")
        if rows[-1] != [0.0] * (side - 1) + [1.0]:
            raise ValueError(
                f"rasterize: {name} must be [0 ... 0 1] in its last row, got {rows[-1]}"
            )
        if side == 3 and (rows[0][1] != 0 or rows[1][0] != 0 or min(rows[0][0], rows[1][1]) <= 0):
            raise ValueError(
                f"rasterize: K must be without skew and with focal lengths > 0, got {rows}"
            )
    for name, size in (("width", camera.width), ("height", camera.height)):
        if not 1 <= size <= 1 << 16:
            raise ValueError(f"rasterize: {name} must be 1 to 65536 pixels, got {size}")


def _check_finite(
    means: Tensor, quats: Tensor, scales: Tensor, groups: Sequence[ChannelGroup]
) -> None:
    """What the kernel checks while it reads, for the reference."""
    named = [("means", means), ("quats", quats), ("scales", scales)]
    for i, group in enumerate(groups):
        named += [(f"groups[{i}].values", group.values), (f"groups[{i}].weight", group.weight)]
        if group.shape is not None:
            named.append((f"groups[{i}].shape.quats", group.shape.quats))
            named.append((f"groups[{i}].shape.scales", group.shape.scales))
    for name, tensor in named:
        low = 0.0 if name.endswith(("scales", "weight")) else -math.inf
        high = 1.0 if name.endswith("weight") else math.inf
        good = tensor.isfinite() & (tensor >= low) & (tensor <= high)
        if not good.all():
            row = int((~good).nonzero()[0, 0])
            raise ValueError(
                f"rasterize: {name} must be finite and in [{low}, {high}], got {tensor[row].tolist()} in row {row}"
            )
