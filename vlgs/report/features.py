"""Feature maps of any width as colours that mean the same in every view of a scene."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vlgs.report.colors import to_uint8

SAMPLE = 20_000
"""Pixels per view that the axes and bounds are found from, of features of up to `NARROW` numbers; of wider ones fewer, as memory grows."""
NARROW = 16


@dataclass(frozen=True)
class FeatureColors:
    """A linear map from features to RGB, shared by all views of a scene."""

    axes: Float[Tensor, "d 3"]
    low: Float[Tensor, "3"]
    """Shown as 0."""
    high: Float[Tensor, "3"]
    """Shown as 1."""


def fit_feature_colors(features: Iterable[Float[Tensor, "h w d"]]) -> FeatureColors:
    """Three channels are shown as they are; more or fewer by their first three principal axes.

    Bounds are the 1st and 99th percentile over all views, so that one odd pixel does not grey out the rest.
    """
    pixels = torch.cat([_sample(feature) for feature in features]).double()
    d = pixels.shape[1]
    axes = torch.eye(3, dtype=torch.float64) if d == 3 else _principal_axes(pixels)
    shown = pixels @ axes
    low, high = shown.quantile(torch.tensor([0.01, 0.99], dtype=torch.float64), dim=0)
    return FeatureColors(axes.float(), low.float(), high.float())


def paint_features(
    feature: Float[Tensor, "h w d"], colors: FeatureColors
) -> UInt8[Tensor, "h w 3"]:
    """A feature map as RGB; a channel that is constant over the scene stays black."""
    span = (colors.high - colors.low).clamp_min(1e-12)
    return to_uint8((feature.float() @ colors.axes - colors.low) / span)


def _sample(feature: Float[Tensor, "h w d"]) -> Float[Tensor, "p d"]:
    flat = feature.flatten(0, 1)
    sample = SAMPLE * NARROW // max(NARROW, flat.shape[1])
    return flat[:: max(1, len(flat) // sample)].clone()  # a view would keep the whole image


def _principal_axes(pixels: Float[Tensor, "p d"]) -> Float[Tensor, "d 3"]:
    """Axes of largest variance; each points to where its largest component is positive, so that colours do not flip."""
    centred = pixels - pixels.mean(dim=0)
    axes = torch.linalg.eigh(centred.T @ centred).eigenvectors.flip(1)[:, :3]  # [d, <= 3]
    signs = axes.gather(0, axes.abs().argmax(dim=0, keepdim=True)).sign()
    return torch.nn.functional.pad(axes * signs, (0, 3 - axes.shape[1]))
