"""Gaussians: parameters, initialisation, spherical harmonics, densification and PLY files."""

from vlgs.gaussians.config import DensifyConfig, GaussiansConfig
from vlgs.gaussians.densify import DensifyReport, DensifyState, densify, reset_opacity
from vlgs.gaussians.init import initialise
from vlgs.gaussians.parameters import LANGUAGE_SHAPE, PARAMETERS, activate
from vlgs.gaussians.ply import read_ply, write_ply
from vlgs.gaussians.sh import rgb_to_sh, sh_to_rgb
from vlgs.gaussians.sharing import Sharing
from vlgs.ops.view_color import view_color

__all__ = [
    "LANGUAGE_SHAPE",
    "PARAMETERS",
    "DensifyConfig",
    "DensifyReport",
    "DensifyState",
    "GaussiansConfig",
    "Sharing",
    "activate",
    "densify",
    "initialise",
    "read_ply",
    "reset_opacity",
    "rgb_to_sh",
    "sh_to_rgb",
    "view_color",
    "write_ply",
]
