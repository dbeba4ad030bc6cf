"""Colour as real spherical harmonics, with the signs, order and constants of 3DGS; `vlgs.ops.view_color` adds the higher degrees."""

from math import pi, sqrt

from jaxtyping import Float
from torch import Tensor

SH_C0 = 0.5 / sqrt(pi)


def sh_to_rgb(sh0: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Colour that the degree-0 coefficients stand for; in [0, 1] where they came from a colour."""
    return 0.5 + SH_C0 * sh0


def rgb_to_sh(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Degree-0 coefficients of colours in [0, 1]; the inverse of `sh_to_rgb`."""
    return (rgb - 0.5) / SH_C0
