"""Colour as real spherical harmonics, with the signs, order and constants of 3DGS."""

from math import pi, sqrt

import torch
from jaxtyping import Float
from torch import Tensor

SH_C0 = 0.5 / sqrt(pi)
_C1 = sqrt(3 / (4 * pi))
_C2 = (sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi)), sqrt(15 / (16 * pi)))
_C3 = (
    sqrt(35 / (32 * pi)),
    sqrt(105 / (4 * pi)),
    sqrt(21 / (32 * pi)),
    sqrt(7 / (16 * pi)),
    sqrt(105 / (16 * pi)),
)


def sh_to_rgb(sh0: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Colour that the degree-0 coefficients stand for; in [0, 1] where they came from a colour."""
    return 0.5 + SH_C0 * sh0


def rgb_to_sh(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Degree-0 coefficients of colours in [0, 1]; the inverse of `sh_to_rgb`."""
    return (rgb - 0.5) / SH_C0


def view_color_residual(
    shN: Float[Tensor, "n s 3"], directions: Float[Tensor, "n 3"], degree: int
) -> Float[Tensor, "n 3"]:
    """View-dependent part of the colour: the sum over degrees 1 to `degree` (``colour=rgb_dc``, systems.md D.7).

    It is added to the (fused) colour of `sh_to_rgb`; the sum is clamped at 0 afterwards, not here.

    Args:
        shN: Coefficients of degrees 1, 2, ...; those above `degree` are not read.
        directions: Unit vectors from the camera centre to the Gaussians, in world axes.
        degree: Highest degree in use, 0 to 3.

    Raises:
        ValueError: If `degree` is outside 0 to 3 or `shN` has too few coefficients.
    """
    if degree not in range(4):
        raise ValueError(f"sh: degree must be 0, 1, 2 or 3, got {degree}")
    needed = (degree + 1) ** 2 - 1
    if shN.shape[1] < needed:
        raise ValueError(
            f"sh: shN must have at least {needed} coefficients for degree {degree}, got {shN.shape[1]}"
        )
    if degree == 0:
        return torch.zeros_like(directions)
    basis = torch.stack(_basis(directions, degree), dim=1)  # [n, s]
    return torch.einsum("ns,nsc->nc", basis, shN[:, :needed])


def _basis(directions: Float[Tensor, "n 3"], degree: int) -> list[Tensor]:
    x, y, z = directions.unbind(-1)
    values = [-_C1 * y, _C1 * z, -_C1 * x]
    if degree == 1:
        return values
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    values += [
        _C2[0] * xy,
        -_C2[0] * yz,
        _C2[1] * (2 * zz - xx - yy),
        -_C2[0] * xz,
        _C2[2] * (xx - yy),
    ]
    if degree == 2:
        return values
    return [
        *values,
        -_C3[0] * y * (3 * xx - yy),
        _C3[1] * xy * z,
        -_C3[2] * y * (4 * zz - xx - yy),
        _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
        -_C3[2] * x * (4 * zz - xx - yy),
        _C3[4] * z * (xx - yy),
        -_C3[0] * x * (xx - 3 * yy),
    ]
