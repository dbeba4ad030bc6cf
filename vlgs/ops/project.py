"""Gaussians to ellipses on the image plane: the first half of rasterizing."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels, differentiated
from vlgs.types import Camera, RasterConfig


class Splats(NamedTuple):
    """Gaussians on the image plane, as csrc/kernels.h describes them."""

    mean2d: Float[Tensor, "n 2"]
    """Pixels; 0 where culled."""
    ellipse: Float[Tensor, "n 3"]
    """1 / deviation of x given y, slope of x over y, 1 / deviation of y."""
    depth: Float[Tensor, " n"]
    """World units; 0 marks a culled Gaussian. Carries no gradient."""


def project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    camera: Camera,
    config: RasterConfig,
) -> Splats:
    """Where Gaussians lie in an image, on checked input; `vlgs.ops.rasterize_reference` defines it."""
    return KERNELS.of(means)(means, quats, scales, camera, config)


def _kernel_camera(camera: Camera, config: RasterConfig) -> _csrc.Camera:
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    x, y = config.fov_margin * camera.width / 2, config.fov_margin * camera.height / 2
    slopes = [
        -(cx + x) / fx, (camera.width - cx + x) / fx,
        -(cy + y) / fy, (camera.height - cy + y) / fy,
    ]  # fmt: skip
    viewmat = camera.viewmat.flatten().tolist()
    cut = config.near, config.near_sigmas
    return _csrc.Camera(viewmat, [fx, fy, cx, cy], slopes, *cut, config.eps2d)


def _project(means: Tensor, quats: Tensor, scales: Tensor, camera: _csrc.Camera):
    """The fields of `Splats`."""
    mean2d, ellipse = means.new_empty(len(means), 2), means.new_empty(len(means), 3)
    depth = means.new_empty(len(means))
    given = means.contiguous(), quats.contiguous(), scales.contiguous()
    _csrc.project(camera, *arrays(*given, mean2d, ellipse, depth), torch.get_num_threads())
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
        tensors = (means, quats, scales, depth, *upstream, *grads)
        _csrc.project_backward(ctx.camera, *arrays(*tensors), torch.get_num_threads())
        return (*grads, None)


def _on_cpu(
    means: Tensor, quats: Tensor, scales: Tensor, camera: Camera, config: RasterConfig
) -> Splats:
    tensors = means, quats, scales
    if not differentiated(tensors):
        return Splats(*_project(*tensors, _kernel_camera(camera, config)))
    return Splats(*_Project.apply(*tensors, _kernel_camera(camera, config)))


KERNELS = Kernels("project", cpu=_on_cpu)
