"""Gaussians: attributes, initialisation, spherical harmonics, densification and PLY files."""

from vlgs.gaussians.attributes import STANDARD, Attribute, Attributes, attributes_of
from vlgs.gaussians.config import AttributeConfig, DensifyConfig, GaussiansConfig
from vlgs.gaussians.densify import DensifyReport, DensifyState, densify, remove, reset_opacity
from vlgs.gaussians.init import initialise
from vlgs.gaussians.parameters import activate, conform
from vlgs.gaussians.ply import read_ply, write_ply
from vlgs.gaussians.sh import rgb_to_sh, sh_to_rgb
from vlgs.gaussians.sharing import Sharing
from vlgs.ops.view_color import view_color

__all__ = [
    "STANDARD",
    "Attribute",
    "AttributeConfig",
    "Attributes",
    "DensifyConfig",
    "DensifyReport",
    "DensifyState",
    "GaussiansConfig",
    "Sharing",
    "activate",
    "attributes_of",
    "conform",
    "densify",
    "initialise",
    "read_ply",
    "remove",
    "reset_opacity",
    "rgb_to_sh",
    "sh_to_rgb",
    "view_color",
    "write_ply",
]
