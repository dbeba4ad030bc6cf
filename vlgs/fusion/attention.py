"""Fusion by attention over the channels of one Gaussian; `vlgs.ops.attention` computes it, both ways."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vlgs.fusion import require_channels
from vlgs.ops.attention import Token, attend

MAX_CHANNELS = 64
"""A Gaussian costs ``channels^2 * heads * width`` operations, and the layers hold as many weights."""

Init = Literal["zero", "xavier"]


class SelfAttention(nn.Module):
    """Let the channels of one Gaussian attend to each other before rasterising.

    With x = c (+) f and every channel a token of width h (Eq. 5): ``u = x + out(softmax(Q K^T / sqrt(h)) V)``.
    Gaussians never attend to each other, so that the cost is linear in n. The paper calls h "the number of heads", but
    it stands where the width of a key belongs; ``width=1, heads=4`` is the other reading (conf/README.md, D.6), with as many weights.

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
        self.token = Token(heads, width)
        channels, inner = sum(self.widths), sum(self.widths) * heads * width
        self.qkv = nn.Linear(channels, 3 * inner)
        self.out = nn.Linear(inner, channels)
        _initialise("SelfAttention", self.out, init, (self.qkv, 3))

    def forward(
        self, color: Float[Tensor, "n dc"], feature: Float[Tensor, "n df"]
    ) -> tuple[Float[Tensor, "n dc"], Float[Tensor, "n df"]]:
        """Fuse n Gaussians at once; see `vlgs.fusion.Fusion`."""
        require_channels("SelfAttention", color, feature, self.widths)
        inner = self.out.in_features
        weights = self.qkv.weight.split([inner, 2 * inner])
        biases = self.qkv.bias.split([inner, 2 * inner])
        layers = (weights[0], biases[0], weights[1], biases[1], self.out.weight, self.out.bias)
        return _attend("SelfAttention", color, feature, self.token, layers)


class CrossAttention(nn.Module):
    """Let the language channels of one Gaussian attend to its colour channels; colour stays as it is.

    ``u_f = f + out(softmax(Q(f) K(c)^T / sqrt(h)) V(c))`` and ``u_c = c`` (the cross-attention row of Table 4;
    appendix A.1; conf/README.md, D.6). Arguments, errors and start are those of `SelfAttention`.

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
        self.token = Token(heads, width)
        self.query = nn.Linear(feature_dim, feature_dim * heads * width)
        self.key_value = nn.Linear(color_dim, 2 * color_dim * heads * width)
        self.out = nn.Linear(feature_dim * heads * width, feature_dim)
        _initialise("CrossAttention", self.out, init, (self.query, 1), (self.key_value, 2))

    def forward(
        self, color: Float[Tensor, "n dc"], feature: Float[Tensor, "n df"]
    ) -> tuple[Float[Tensor, "n dc"], Float[Tensor, "n df"]]:
        """Fuse n Gaussians at once; see `vlgs.fusion.Fusion`."""
        require_channels("CrossAttention", color, feature, self.widths)
        pairs = [(m.weight, m.bias) for m in (self.query, self.key_value, self.out)]
        layers = tuple(tensor for pair in pairs for tensor in pair)
        return color, _attend("CrossAttention", color, feature, self.token, layers)[1]


def _attend(
    who: str, color: Tensor, feature: Tensor, token: Token, layers: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor]:
    """Fused colour and language; the layers are weight and bias of queries, keys and values, and output."""
    kind = layers[0].dtype
    for name, tensor in (("color", color), ("feature", feature)):
        if tensor.dtype != kind or kind not in (torch.float32, torch.float64):
            raise ValueError(
                f"{who}: {name} must be float32 or float64 like the weights ({kind}), got {tensor.dtype}"
            )
    if len(color) != len(feature):
        raise ValueError(f"{who}: feature must have {len(color)} rows, got {len(feature)}")
    mixes_color = who == "SelfAttention"
    fused = attend(color, feature, token, layers, mixes_color)
    return (fused[0], fused[1]) if mixes_color else (color, fused[0])


def _require_sizes(who: str, color_dim: int, feature_dim: int, width: int, heads: int) -> None:
    sizes = (color_dim, feature_dim, width, heads)
    if min(sizes) < 1:
        raise ValueError(
            f"{who}: color_dim, feature_dim, width and heads must be positive, got {sizes}"
        )
    if color_dim + feature_dim > MAX_CHANNELS:
        raise ValueError(
            f"{who}: color_dim + feature_dim must be <= {MAX_CHANNELS}, because time grows with its square (use "
            f"head=autoencoder, or fusion=mlp or none), got {color_dim} + {feature_dim}"
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
