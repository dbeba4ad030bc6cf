"""Two Gaussians in the place of one, side by side on its longest axis (Deng et al. 2024, "Efficient Density Control for 3D Gaussian Splatting").

3DGS adds a copy where its original is, which learns the same until Adam's moments part them, and draws the children of large ones at random, so that
they lie over each other or leave a hole. Two halves of a Gaussian are told apart from the first step on, and no seed has a part in where they are.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.gaussians.attributes import Attributes
from vlgs.gaussians.logistic import logit
from vlgs.geometry import quat_to_rotmat

ALONG, ACROSS = 0.6, 0.85
"""Scales of a half on the longest axis and on the others, in those of the whole."""
OFFSET = math.sqrt(1 - ALONG**2)
"""Of a half's centre from the whole's, in standard deviations of it: both together vary on that axis as the whole does."""
WEIGHT = 0.6
"""Opacity of a half in that of the whole; at a whole one less is won. The indicator stays: lowered as well, it answered no better
(results/bench/tried.md)."""


def halve(
    values: dict[str, Tensor],
    halves: Bool[Tensor, " m"],
    attributes: Attributes,
    prune_below: float,
) -> None:
    """Move and shrink the halves, in place, of which each still has the values of its whole.

    Args:
        values: Raw parameters; every entry has one row per Gaussian.
        halves: Rows of halves: of all wholes the first ones, then in the same order the second ones.
        attributes: The table of `values`.
        prune_below: An opacity that would be pruned for it is left as it is.
    """
    shape = values["log_scales"][halves]
    longest = shape.argmax(dim=1, keepdim=True)
    side = shape.new_tensor([OFFSET, -OFFSET]).repeat_interleave(len(shape) // 2)[:, None]
    away = side * shape.gather(1, longest).exp()
    offsets = torch.zeros_like(shape).scatter(1, longest, away)
    rotation = quat_to_rotmat(values["quats"][halves])
    values["means"][halves] += (rotation @ offsets[..., None]).squeeze(-1)
    for name, scales in values.items():
        if attributes[name].role == "scale":  # a shape of language's own has its own longest axis
            longest = scales[halves].argmax(dim=1, keepdim=True)
            across = torch.full_like(shape, math.log(ACROSS))
            scales[halves] += across.scatter(1, longest, math.log(ALONG))
    whole = values["opacity_logits"][halves]
    half = _logits_of_share(whole)
    values["opacity_logits"][halves] = torch.where(half > logit(prune_below), half, whole)


def _logits_of_share(logits: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Of `WEIGHT` times the opacity. By numpy, as the bits of torch's logarithms depend on the number of threads."""
    log_share = math.log(WEIGHT) - np.logaddexp(0.0, -logits.double().numpy())
    return torch.from_numpy(log_share - np.log1p(-np.exp(log_share))).to(logits.dtype)
