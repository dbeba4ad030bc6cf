"""The raw parameters that the optimiser moves, and what they stand for."""

from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from vlgs.types import Gaussians, Shape

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
opacity_logits [n], indicator_logits [n] ([n, levels] with ``indicator=per_level``), features [n, d]. Row i of every one of them is
Gaussian i."""

LANGUAGE_SHAPE = ("language_quats", "language_log_scales")
"""Keys of the second covariance, for language, which exist with ``sharing=pos`` only: [n, 4] and [n, 3]."""


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
        opacities=_logistic(params["opacity_logits"]),
        indicators=_logistic(params["indicator_logits"]),
        sh0=params["sh0"],
        shN=params["shN"],
        features=params["features"],
        language_shape=_language_shape(params),
    )


def _language_shape(params: nn.ParameterDict | Mapping[str, Tensor]) -> Shape | None:
    if "language_quats" not in params:
        return None
    return Shape(params["language_quats"], params["language_log_scales"].exp())


def with_language_shape(params: Mapping[str, Tensor], own: bool) -> dict[str, Tensor]:
    """The same Gaussians with, or without, covariances of their own for language; they start as colour's."""
    shared = {name: value for name, value in params.items() if name not in LANGUAGE_SHAPE}
    if not own:
        return shared
    started = {f"language_{name}": params[name].clone() for name in ("quats", "log_scales")}
    return shared | {name: params.get(name, started[name]) for name in LANGUAGE_SHAPE}


def with_level_indicators(params: Mapping[str, Tensor], levels: int | None) -> dict[str, Tensor]:
    """The same Gaussians with an indicator for each of so many mask levels, or with one for all.

    One becomes several equal ones; several become one by the mean of their logits, as do those of another number of levels.
    """
    logits = params["indicator_logits"]
    if logits.dim() == 2 and logits.shape[1] != levels:
        logits = logits.mean(dim=1)
    if logits.dim() == 1 and levels is not None:
        logits = logits[:, None].repeat(1, levels)
    return {**params, "indicator_logits": logits}


def complete(params: Mapping[str, Tensor], feature_dim: int) -> dict[str, Tensor]:
    """All of `PARAMETERS`, in order, of what another system's file holds, and `LANGUAGE_SHAPE` where it is there.

    Args:
        params: Without `indicator_logits` the opacity's take their place; without `features` they are zero.
        feature_dim: Width of the language codes where there are none.
    """
    n, opacity = len(params["means"]), params["opacity_logits"]
    absent = {"indicator_logits": opacity.clone(), "features": torch.zeros(n, feature_dim)}
    named = {name: params[name] if name in params else absent[name] for name in PARAMETERS}
    return named | {name: params[name] for name in LANGUAGE_SHAPE if name in params}


def logit(probability: float) -> float:
    """Inverse of the logistic function for a value strictly between 0 and 1."""
    return torch.tensor(probability, dtype=torch.float64).logit().item()


class _Logistic(torch.autograd.Function):
    """1 / (1 + exp(-x)), whose bits do not depend on the number of threads: those of `torch.sigmoid` do (torch 2.13).

    Its slope is not y (1 - y), which is 0 in float32 from x = 17 on and would hold a Gaussian at 1 for ever.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.neg().exp_().add_(1).reciprocal_()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_y: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (x,) = ctx.saved_tensors
        falloff = x.abs().neg_().exp_()  # the slope is even in x
        return d_y * falloff / (1 + falloff).square_()


def _logistic(x: Tensor) -> Tensor:
    return cast(Tensor, _Logistic.apply(x))
