"""Gaussians as the page reads them (``page/data.js``): columns of one byte for each Gaussian, and what the bytes stand for.

A column is all Gaussians' first bytes, then all second ones: neighbours in the file are neighbours in the scene, which gzip likes.

    places      6   coarse and fine byte of x, y and z, folded: see `_fold`
    scales      3   logarithms, between bounds that are common to all axes
    quats       4   w x y z of the unit quaternion, 127 + 127 q
    color       3   of degree 0, between bounds that are common to all channels
    opacity     1   255 o
    harmonics   3k  red, green, blue of each coefficient above degree 0, in few steps: see `_HARMONIC_STEPS`
    weights     w   255 l: what blends language, one or one for each mask level that answers a word
    relevancy   k   of each word, between its least and its largest
    language_scales, language_quats   where language has shapes of its own
"""

import gzip
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.export.content import Content, Word
from vlgs.formats.compressed import morton_order
from vlgs.gaussians.sh import sh_to_rgb

_RARE = 1e-3
"""Share of colours at each end that may be clipped: a few very bright ones would take the steps of all others."""

_HARMONIC_STEPS = 8
"""To each side of 0. With 8 the pictures of a trained glassware keep 62 dB and degree 3 takes 23 bytes a Gaussian in the page; with 127, 73 dB and 48."""


@dataclass(frozen=True)
class Packed:
    """Columns, and how the page finds its way in them."""

    data: bytes
    """Gzipped."""
    about: dict[str, Any]
    """JSON values."""


def pack(content: Content, center: Float[Tensor, " 3"], unit: float) -> Packed:
    """Round everything to bytes.

    Args:
        content: At least one Gaussian.
        center: Where places are stored most finely.
        unit: Distance from there up to which they are stored about as finely, such as that of the cameras.
    """
    content = content.keep(torch.from_numpy(morton_order(content.cloud.params["means"])))
    params = content.cloud.params
    places, bounds = _places(params["means"], center, unit)
    columns = {"places": places}
    own = "language_log_scales" in params
    shapes = [params["log_scales"], *([params["language_log_scales"]] if own else [])]
    scales = (min(s.min().item() for s in shapes), max(s.max().item() for s in shapes))
    columns["scales"] = _bytes(params["log_scales"], *scales)
    columns["quats"] = _turns(params["quats"])
    rgb = sh_to_rgb(params["sh0"])
    color = (min(0.0, _quantile(rgb, _RARE)), max(1.0, _quantile(rgb, 1 - _RARE)))
    columns["color"] = _bytes(rgb, *color)
    columns["opacity"] = _bytes(params["opacity_logits"].sigmoid()[:, None], 0.0, 1.0)
    further = params["shN"].flatten(1)
    reach = _quantile(further.abs(), 1 - _RARE) if further.numel() else 0.0
    if reach > 0:
        steps = (further / reach * _HARMONIC_STEPS).round()
        steps = steps.clamp(-_HARMONIC_STEPS, _HARMONIC_STEPS) + _HARMONIC_STEPS
        columns["harmonics"] = steps.to(torch.uint8)
    ends = [_ends(word.relevancy) for word in content.words]
    if content.words:
        columns["weights"] = _bytes(torch.stack(list(content.weights), dim=1), 0.0, 1.0)
        asked = zip(content.words, ends, strict=True)
        answers = [_bytes(word.relevancy[:, None], *own_ends) for word, own_ends in asked]
        columns["relevancy"] = torch.cat(answers, dim=1)
    if own and content.words:
        columns["language_scales"] = _bytes(params["language_log_scales"], *scales)
        columns["language_quats"] = _turns(params["language_quats"])
    about = {
        "count": content.count,
        "columns": [[name, column.shape[1]] for name, column in columns.items()],
        "places": {"center": center.tolist(), "unit": unit, **bounds},
        "scales": {"low": scales[0], "high": scales[1]},
        "color": color,
        "harmonics": (-reach, reach * (255 / _HARMONIC_STEPS - 1)),  # what 0 and 255 stand for
        "words": [_word(*pair) for pair in zip(content.words, ends, strict=True)],
    }
    raw = b"".join(column.T.contiguous().numpy().tobytes() for column in columns.values())
    return Packed(gzip.compress(raw, mtime=0), about)


def _places(
    means: Float[Tensor, "n 3"], center: Float[Tensor, " 3"], unit: float
) -> tuple[UInt8[Tensor, "n 6"], dict[str, list[float]]]:
    """Sixteen bits an axis, of the folded distance from the centre."""
    folded = _fold((means.double() - center) / unit)
    low, high = folded.amin(dim=0), folded.amax(dim=0)
    span = torch.where(high > low, high - low, 1.0)
    steps = ((folded - low) / span * 65535).round().to(torch.int32)
    pairs = torch.stack([steps >> 8, steps & 255], dim=2).flatten(1)
    return pairs.to(torch.uint8), {"low": low.tolist(), "high": (low + span).tolist()}


def _fold(distance: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """A logarithm that is linear around 0, so that one Gaussian at the horizon does not take the steps of all others."""
    return distance.sign() * distance.abs().log1p()


def _bytes(value: Float[Tensor, "n c"], low: float, high: float) -> UInt8[Tensor, "n c"]:
    span = high - low if high > low else 1.0
    return ((value - low) / span * 255).round().clamp(0, 255).to(torch.uint8)


def _turns(quats: Float[Tensor, "n 4"]) -> UInt8[Tensor, "n 4"]:
    unit = normalize(quats, dim=1)
    # q and -q are one rotation; with one sign the bytes are alike where rotations are.
    unit = torch.where(unit[:, :1] < 0, -unit, unit)
    return (unit * 127 + 127).round().to(torch.uint8)


def _word(word: Word, ends: tuple[float, float]) -> dict[str, Any]:
    """What the page knows of a word: `stored` are the ends of its bytes, `heat` those of its colours."""
    heat = (word.range.low, max(word.range.high, word.range.low + 1e-6))
    said = {"name": word.name, "weight": word.weight, "stored": ends, "heat": heat}
    return said | {"threshold": min(max(word.range.threshold(), ends[0]), ends[1])}


def _ends(value: Float[Tensor, " n"]) -> tuple[float, float]:
    return value.min().item(), value.max().item()


def _quantile(value: Float[Tensor, "n c"], share: float) -> float:
    return float(np.quantile(value.numpy(), share))
