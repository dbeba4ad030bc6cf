"""Converts a model to plain Gaussians, from which another program draws the same pictures without fusion or indicator."""

from collections.abc import Mapping, Sequence
from math import log
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields import Field, HasGaussians, PointCloud
from vlgs.fields.splat import SplatModel
from vlgs.fusion import Fusion
from vlgs.gaussians.parameters import at_levels
from vlgs.gaussians.ply import PLAIN, SH_COEFFICIENTS, write_ply
from vlgs.gaussians.sh import SH_C0, sh_to_rgb
from vlgs.geometry import camera_center
from vlgs.ops.view_color import view_color
from vlgs.types import Camera

HIGHEST_LOGIT = log(2.0**24 - 1)
"""A weight of 1 has no finite logit; this one is 6e-8 below it, the step of float32, so that training can still go on from it."""
ROWS = 1 << 13
"""Gaussians whose harmonics are fitted at once: bounds the memory."""
RIDGE = 1e-3
"""Regularisation of the fitted harmonics: those that no view determines keep their value."""


def write_point_cloud(path: Path, field: Field, cameras: Sequence[Camera]) -> bool:
    """Write ``point_cloud.ply``, if the field has Gaussians; whether it has.

    Args:
        path: Where to.
        field: Of one model.
        cameras: Where colours count, at least one; the training cameras.
    """
    if not isinstance(field, HasGaussians):
        return False
    cloud = field.point_cloud(cameras)
    write_ply(path, cloud.params, notes=cloud.notes)
    return True


@torch.no_grad()
def point_cloud(model: SplatModel, cameras: Sequence[Camera], color: bool = True) -> PointCloud:
    """Apply fusion and indicator for good.

    Colour is that of degree 0 after fusion, with the harmonics that the model adds to it; those that have not joined yet are
    zero. Where fusion sees the colour of each view (``gaussians.color=evaluated``) no harmonics give it exactly: they are
    fitted to what the cameras see, the codes are the mean, and the notes tell the error.

    Args:
        model: The trained scene.
        cameras: Where colour is fitted, at least one; the training cameras. Without ``evaluated`` they are not looked at.
        color: Off: the model was trained for language alone, and its untrained opacity is replaced by what blends language.
    """
    params = {name: value.detach().clone() for name, value in model.splats.items()}
    joined = (model.sh_degree + 1) ** 2 - 1
    params["shN"][:, joined:] = 0
    if model.evaluated:
        notes = [_fit_views(model, params, cameras)]
    else:
        fused = model.fuse()
        # As a difference, so that a colour that fusion leaves alone keeps its bits.
        params["sh0"] += (fused.color - sh_to_rgb(params["sh0"])) / SH_C0
        params["features"] = fused.feature.clone()
        notes = ["f_dc f_rest: colour after fusion, exact"]
    params["indicator_logits"] = _weight_logits(model)
    if color:
        notes.append("opacity: logit of what blends colour")
    else:
        params["opacity_logits"] = at_levels(params["indicator_logits"], None).clone()
        notes = ["trained for language alone: colour is untrained, opacity is that of language"]
    if params["features"].any():
        levels = f", {model.levels} mask levels side by side" if model.levels > 1 else ""
        notes.append(f"lang_*: codes after fusion{levels}; indicator*: logit of what blends them")
    else:
        notes.append("lang_*: no language was trained, all codes are zero")
    return PointCloud(params, (PLAIN, *notes), model.raster)


def _weight_logits(model: SplatModel) -> Float[Tensor, " n *levels"]:
    """Logits of what blends language: a parameter's own bits where it is one."""
    gaussians = model.gaussians()
    weight = model.indicator(gaussians)
    if weight.equal(gaussians.indicators):
        return model.splats["indicator_logits"].detach().clone()
    if weight.equal(gaussians.opacities):
        return model.splats["opacity_logits"].detach().clone()
    return weight.double().logit().clamp(-HIGHEST_LOGIT, HIGHEST_LOGIT).to(weight)


def _fit_views(model: SplatModel, params: dict[str, Tensor], cameras: Sequence[Camera]) -> str:
    """Put the nearest harmonics and the mean codes into `params`; returns the note that tells how near."""
    eyes = [camera_center(camera.viewmat) for camera in cameras]
    squares, count = 0.0, max(model.count, 1)
    for rows in torch.arange(model.count).split(ROWS):
        part = {name: params[name][rows] for name in ("means", "sh0", "shN", "features")}
        change, codes, error = _fit(model.fusion, part, eyes)
        params["sh0"][rows] += (change[:, 0] / SH_C0).to(part["sh0"])
        params["shN"][rows] += change[:, 1:].to(part["shN"])
        params["features"][rows] = codes
        squares += error.sum().item()
    rms = (max(squares, 0.0) / (3 * count * len(eyes))) ** 0.5
    return (
        f"f_dc f_rest: harmonics fitted to the fused colours of {len(eyes)} views, off by {rms:.5f} rms of 1; "
        "lang_*: mean over these views"
    )


def _fit(
    fusion: Fusion, part: Mapping[str, Tensor], eyes: Sequence[Float[Tensor, " 3"]]
) -> tuple[Float[Tensor, "r c 3"], Float[Tensor, "r d"], Float[Tensor, " r"]]:
    """Least squares over the eyes: what to add to colour and harmonics, the mean code, and the squared error that is left."""
    n, coefficients = len(part["means"]), part["shN"].shape[1] + 1
    gram = torch.zeros(n, coefficients, coefficients, dtype=torch.float64)
    moment = torch.zeros(n, coefficients, 3, dtype=torch.float64)
    squares, codes = torch.zeros(n, dtype=torch.float64), torch.zeros_like(part["features"])
    for eye in eyes:
        basis = _basis(part["means"], coefficients - 1, eye)
        own = sh_to_rgb(part["sh0"]) + torch.einsum("nk,nkc->nc", basis[:, 1:], part["shN"])
        seen, code = fusion(own.clamp_min(0), part["features"])
        # Renderers clamp at 0, so that two negative colours are one.
        gap = torch.where((own <= 0) & (seen <= 0), 0, seen - own).double()
        basis = basis.double()
        gram += basis[:, :, None] * basis[:, None, :]
        moment += basis[:, :, None] * gap[:, None, :]
        squares += gap.square().sum(dim=1)
        codes += code / len(eyes)
    cost = torch.full((coefficients,), RIDGE * len(eyes), dtype=torch.float64)
    cost[0] = 0
    change = torch.linalg.solve(gram + cost.diag(), moment)
    fitted = (gram @ change - 2 * moment).mul(change).sum(dim=(1, 2))
    return change, codes, squares + fitted


def _basis(
    means: Float[Tensor, "n 3"], harmonics: int, eye: Float[Tensor, " 3"]
) -> Float[Tensor, "n c"]:
    """1, then the harmonics of degree 1 and up in the direction from an eye: the slopes of colour by its coefficients."""
    ones = torch.ones_like(means)
    if harmonics == 0:
        return ones[:, :1]
    with torch.enable_grad():
        rest = means.new_zeros(len(means), harmonics, 3, requires_grad=True)
        degree = SH_COEFFICIENTS.index(harmonics)
        color = view_color(ones, rest, means, eye, degree)
    (slopes,) = torch.autograd.grad(color, rest, ones)
    return torch.cat([ones[:, :1], slopes[..., 0]], dim=1)
