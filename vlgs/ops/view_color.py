"""Colour that depends on where it is seen from: real spherical harmonics, with the signs, order and constants of 3DGS."""

from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels


def view_color(
    color: Float[Tensor, "n 3"],
    shN: Float[Tensor, "n s 3"],
    means: Float[Tensor, "n 3"],
    eye: Float[Tensor, " 3"],
    degree: int,
) -> Float[Tensor, "n 3"]:
    """Colour seen from a point: `color` plus the sum over degrees 1 to `degree`, clamped at 0 (``gaussians.color=rgb_dc``).

    tests/gaussians/test_gaussians_sh.py has the definition in plain torch. As in 3DGS the direction reaches the gradient of `means`: the colour of a Gaussian depends on where it is seen from.

    Args:
        color: The (fused) colour of `sh_to_rgb`.
        shN: Coefficients of degrees 1, 2, ...; those above `degree` are not read.
        means: World units.
        eye: Camera centre, world units; no gradient is formed.
        degree: Highest degree in use, 0 to 3.

    Raises:
        ValueError: If `degree` is outside 0 to 3, `shN` has too few coefficients, or dtypes differ.
    """
    if degree not in range(4):
        raise ValueError(f"sh: degree must be 0, 1, 2 or 3, got {degree}")
    needed = (degree + 1) ** 2 - 1
    if shN.shape[1] < needed:
        raise ValueError(
            f"sh: shN must have at least {needed} coefficients for degree {degree}, got {shN.shape[1]}"
        )
    if degree == 0:
        return color.clamp_min(0.0)
    if color.dtype not in (torch.float32, torch.float64) or not (
        color.dtype == shN.dtype == means.dtype
    ):
        raise ValueError(
            "sh: color, shN and means must be float32 or float64 alike, "
            f"got {color.dtype}, {shN.dtype}, {means.dtype}"
        )
    return KERNELS.of(color)(color, shN, means, eye, degree)


class _ViewColor(torch.autograd.Function):
    """`view_color` of degree 1 to 3, by csrc/view_color.cpp."""

    @staticmethod
    def forward(ctx: Any, color: Tensor, shN: Tensor, means: Tensor, eye: list[float], degree: int):
        tensors = color.contiguous(), shN.contiguous(), means.contiguous()
        out = torch.empty_like(tensors[0])
        _csrc.view_color(*arrays(*tensors), eye, degree, *arrays(out), torch.get_num_threads())
        ctx.save_for_backward(*tensors)
        ctx.eye, ctx.degree = eye, degree
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_out: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        color, shN, means = ctx.saved_tensors
        grads = torch.empty_like(color), torch.empty_like(shN), torch.empty_like(means)
        _csrc.view_color_backward(
            *arrays(color, shN, means), ctx.eye, ctx.degree, *arrays(d_out.contiguous(), *grads), torch.get_num_threads()
        )  # fmt: skip
        return (*grads, None, None)


def _on_cpu(color: Tensor, shN: Tensor, means: Tensor, eye: Tensor, degree: int) -> Tensor:
    return cast(Tensor, _ViewColor.apply(color, shN, means, eye.tolist(), degree))


KERNELS = Kernels("view_color", cpu=_on_cpu)
