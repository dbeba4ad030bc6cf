"""Attention over the channels of one Gaussian, within one modality or from one to the other; csrc/attention.cpp."""

from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.arrays import array_list, arrays
from vlgs.ops.device import Kernels


class Token(NamedTuple):
    """What every channel becomes."""

    heads: int
    width: int


def attend(
    color: Float[Tensor, "n dc"],
    feature: Float[Tensor, "n df"],
    token: Token,
    layers: tuple[Tensor, ...],
    mixes_color: bool,
) -> tuple[Tensor, ...]:
    """Fused colour and language with self-attention, or fused language alone with cross-attention, on checked input.

    tests/fusion/test_fusion_attention.py has the definition in plain torch.

    Args:
        color: One row per Gaussian.
        feature: Language, one row per Gaussian.
        token: What every channel becomes.
        layers: Weight and bias of queries, of keys and values, and of the output.
        mixes_color: Whether all channels attend to all (self), or language to colour (cross).
    """
    return KERNELS.of(color)(color, feature, token, layers, mixes_color)


class _Attention(torch.autograd.Function):
    """(fused colour, fused language), or the second alone in cross-attention."""

    @staticmethod
    def forward(ctx: Any, token: Token, mixes_color: bool, *tensors: Tensor):
        tensors = tuple(t.contiguous() for t in tensors)
        color, feature, *layers = tensors
        out_color = torch.empty_like(color) if mixes_color else None
        out_feature = torch.empty_like(feature)
        _csrc.attention(
            *arrays(color, feature), array_list(layers), token.heads, token.width, mixes_color,
            *arrays(out_color, out_feature), torch.get_num_threads(),
        )  # fmt: skip
        ctx.save_for_backward(*tensors)
        ctx.token, ctx.mixes_color = token, mixes_color
        return (out_feature,) if out_color is None else (out_color, out_feature)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        color, feature, *layers = ctx.saved_tensors
        d_color, d_feature, *d_layers = (torch.empty_like(t) for t in ctx.saved_tensors)
        *d_out_color, d_out_feature = (d.contiguous() for d in grad_outputs)
        given = d_out_color[0] if d_out_color else None, d_out_feature
        _csrc.attention_backward(
            *arrays(color, feature), array_list(layers), ctx.token.heads, ctx.token.width, ctx.mixes_color,
            *arrays(*given, d_color, d_feature), array_list(d_layers), torch.get_num_threads(),
        )  # fmt: skip
        return (None, None, d_color, d_feature, *d_layers)


def _on_cpu(
    color: Tensor, feature: Tensor, token: Token, layers: tuple[Tensor, ...], mixes_color: bool
) -> tuple[Tensor, ...]:
    fused = _Attention.apply(token, mixes_color, color, feature, *layers)
    return cast(tuple[Tensor, ...], fused)


KERNELS = Kernels("attention", cpu=_on_cpu)
