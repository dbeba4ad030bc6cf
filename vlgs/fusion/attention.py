"""Fusion by attention over the channels of one Gaussian.

Everything between the linear layers is laid out ``[block, channel, ..., Gaussian]``: Gaussians are many and channels few, so
that each product below is one pass over contiguous memory. That takes a third of the time of 6 x 6 matrix products
batched over Gaussians.
"""

from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from vlgs.fusion import require_channels
from vlgs.fusion.blocks import from_blocks, linear, to_blocks

MAX_CHANNELS = 64
"""Scores take ``channels^2 * heads`` numbers per Gaussian: at 64 channels 1.6 GB for 100 000 Gaussians in float32."""

Init = Literal["zero", "xavier"]


def channel_attention(
    query: Float[Tensor, "b dq heads width m"],
    key: Float[Tensor, "b dk heads width m"],
    value: Float[Tensor, "b dk heads width m"],
) -> Float[Tensor, "b dq heads width m"]:
    """``softmax(Q K^T / sqrt(width)) V`` inside each of b x m Gaussians, the softmax over keys (Eq. attention)."""
    return _ChannelAttention.apply(query * query.shape[3] ** -0.5, key, value)  # pyright: ignore[reportReturnType]


class _ChannelAttention(torch.autograd.Function):
    """Attention with its derivative in closed form: half the passes over memory of what autograd would record."""

    @staticmethod
    def forward(ctx: Any, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        shares = _contract(query[:, :, None], key[:, None], 4)  # [b, dq, dk, heads, m]
        # Not `torch.softmax`, whose last bit depends on the number of threads. Less the maximum, no finite score overflows.
        shares -= shares.amax(dim=2, keepdim=True)
        shares.exp_()
        shares /= shares.sum(dim=2, keepdim=True)
        ctx.save_for_backward(query, key, value, shares)
        return _contract(shares[..., None, :], value[:, None], 2)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] (the decorator is untyped)
        ctx: Any, *grads: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        query, key, value, shares = ctx.saved_tensors
        d_out = grads[0][:, :, None]  # [b, dq, 1, heads, width, m]
        d_scores = _contract(d_out, value[:, None], 4)
        d_scores -= (d_scores * shares).sum(dim=2, keepdim=True)
        d_scores *= shares
        d_query = _contract(d_scores[..., None, :], key[:, None], 2)
        d_key = _contract(d_scores[..., None, :], query[:, :, None], 1)
        return d_query, d_key, _contract(shares[..., None, :], d_out, 1)


def _contract(left: Tensor, right: Tensor, dim: int) -> Tensor:
    """``(left * right).sum(dim)`` without the product in memory."""
    pairs = list(zip(left.unbind(dim), right.unbind(dim), strict=True))
    total = pairs[0][0] * pairs[0][1]
    for a, b in pairs[1:]:
        total.addcmul_(a, b)
    return total


class SelfAttention(nn.Module):
    """Let the channels of one Gaussian attend to each other before rasterising.

    With x = c (+) f and every channel a token of width h (Eq. attention): ``u = x + out(softmax(Q K^T / sqrt(h)) V)``.
    Gaussians never attend to each other, so that the cost is linear in n. The paper calls h "the number of heads", but
    it stands where the width of a key belongs; ``width=1, heads=4`` is the other reading (S. D.6), with as many weights.

    Args:
        color_dim: Channels of colour d_c.
        feature_dim: Channels of language d_f.
        width: Token width h per head.
        heads: Number of independent attentions.
        init: Start of the output layer: ``zero`` makes step 0 equal to `NoFusion`; ``xavier`` mixes from the start.

    Raises:
        ValueError: If an argument is not positive, or there are more than `MAX_CHANNELS` channels.

    Example:
        >>> fuse = SelfAttention(color_dim=3, feature_dim=3, width=4)
        >>> color, feature = fuse(torch.rand(10, 3), torch.rand(10, 3))
        >>> color.shape, feature.shape
        (torch.Size([10, 3]), torch.Size([10, 3]))
    """

    def __init__(
        self,
        color_dim: int,
        feature_dim: int,
        width: int = 4,
        heads: int = 1,
        init: Init = "zero",
    ):
        super().__init__()
        _require_sizes("SelfAttention", color_dim, feature_dim, width, heads)
        self.widths = (color_dim, feature_dim)
        self.token = (sum(self.widths), heads, width)
        channels, inner = sum(self.widths), sum(self.widths) * heads * width
        self.qkv = nn.Linear(channels, 3 * inner)
        self.out = nn.Linear(inner, channels)
        _initialise("SelfAttention", self.out, init, (self.qkv, 3))

    def forward(
        self, color: Float[Tensor, "n dc"], feature: Float[Tensor, "n df"]
    ) -> tuple[Float[Tensor, "n dc"], Float[Tensor, "n df"]]:
        """Fuse n Gaussians at once; see `vlgs.fusion.Fusion`."""
        require_channels("SelfAttention", color, feature, self.widths)
        x = to_blocks(torch.cat([color, feature], dim=-1))
        q, k, v = linear(self.qkv, x).unflatten(1, (3, *self.token)).unbind(1)
        mixed = linear(self.out, channel_attention(q, k, v).flatten(1, 3))
        d_color, d_feature = from_blocks(mixed, len(color)).split(self.widths, dim=-1)
        return color + d_color, feature + d_feature


class CrossAttention(nn.Module):
    """Let the language channels of one Gaussian attend to its colour channels; colour stays as it is.

    ``u_f = f + out(softmax(Q(f) K(c)^T / sqrt(h)) V(c))`` and ``u_c = c`` (the cross-attention row of tab:ab-multi, appendix
    sec:lr, S. D.6). Arguments, errors and start are those of `SelfAttention`.

    Example:
        >>> color = torch.rand(10, 3)
        >>> CrossAttention(color_dim=3, feature_dim=3)(color, torch.rand(10, 3))[0] is color
        True
    """

    def __init__(
        self,
        color_dim: int,
        feature_dim: int,
        width: int = 4,
        heads: int = 1,
        init: Init = "zero",
    ):
        super().__init__()
        _require_sizes("CrossAttention", color_dim, feature_dim, width, heads)
        self.widths = (color_dim, feature_dim)
        self.token = (heads, width)
        self.query = nn.Linear(feature_dim, feature_dim * heads * width)
        self.key_value = nn.Linear(color_dim, 2 * color_dim * heads * width)
        self.out = nn.Linear(feature_dim * heads * width, feature_dim)
        _initialise("CrossAttention", self.out, init, (self.query, 1), (self.key_value, 2))

    def forward(
        self, color: Float[Tensor, "n dc"], feature: Float[Tensor, "n df"]
    ) -> tuple[Float[Tensor, "n dc"], Float[Tensor, "n df"]]:
        """Fuse n Gaussians at once; see `vlgs.fusion.Fusion`."""
        require_channels("CrossAttention", color, feature, self.widths)
        color_dim, feature_dim = self.widths
        tokens = to_blocks(color)
        q = linear(self.query, to_blocks(feature)).unflatten(1, (feature_dim, *self.token))
        k, v = linear(self.key_value, tokens).unflatten(1, (2, color_dim, *self.token)).unbind(1)
        mixed = linear(self.out, channel_attention(q, k, v).flatten(1, 3))
        return color, feature + from_blocks(mixed, len(feature))


def _require_sizes(who: str, color_dim: int, feature_dim: int, width: int, heads: int) -> None:
    sizes = (color_dim, feature_dim, width, heads)
    if min(sizes) < 1:
        raise ValueError(
            f"{who}: color_dim, feature_dim, width and heads must be positive, got {sizes}"
        )
    if color_dim + feature_dim > MAX_CHANNELS:
        raise ValueError(
            f"{who}: color_dim + feature_dim must be <= {MAX_CHANNELS}, because memory grows with its square (use "
            f"codec=autoencoder, or fusion=mlp or none), got {color_dim} + {feature_dim}"
        )


@torch.no_grad()
def _initialise(who: str, out: nn.Linear, init: Init, *stacked: tuple[nn.Linear, int]) -> None:
    """Xavier's uniform weights for each of the maps stacked in a layer, as if they were layers of their own; biases 0."""
    if init not in ("zero", "xavier"):
        raise ValueError(f"{who}: init must be 'zero' or 'xavier', got {init!r}")
    for layer, count in stacked:
        for weight in layer.weight.chunk(count):
            nn.init.xavier_uniform_(weight)
        nn.init.zeros_(layer.bias)
    if init == "zero":
        nn.init.zeros_(out.weight)
    else:
        nn.init.xavier_uniform_(out.weight)
    nn.init.zeros_(out.bias)
