"""The raw parameters that the optimiser moves, and what they stand for."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from vlgs.types import Gaussians

PARAMETERS = (
    "means",
    "quats",
    "log_scales",
    "sh0",
    "shN",
    "opacity_logits",
    "indicator_logits",
    "features",
)
"""Keys of the raw parameters: means [n, 3], quats [n, 4], log_scales [n, 3], sh0 [n, 3], shN [n, s, 3],
opacity_logits [n], indicator_logits [n], features [n, d]. Row i of every one of them is Gaussian i."""


def activate(params: nn.ParameterDict | Mapping[str, Tensor]) -> Gaussians:
    """Gaussians in natural units: scales by exp, opacities and indicators by the logistic function.

    Args:
        params: Raw parameters, the keys of `PARAMETERS`.

    Raises:
        ValueError: If a key is missing.
    """
    missing = [name for name in PARAMETERS if name not in params]
    if missing:
        raise ValueError(
            f"gaussians: parameters must have {', '.join(PARAMETERS)}, got no {missing}"
        )
    return Gaussians(
        means=params["means"],
        quats=params["quats"],
        scales=params["log_scales"].exp(),
        opacities=params["opacity_logits"].sigmoid(),
        indicators=params["indicator_logits"].sigmoid(),
        sh0=params["sh0"],
        shN=params["shN"],
        features=params["features"],
    )


def logit(probability: float) -> float:
    """Inverse of the logistic function for a value strictly between 0 and 1."""
    return torch.tensor(probability, dtype=torch.float64).logit().item()
