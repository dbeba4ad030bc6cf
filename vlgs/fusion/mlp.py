"""Fusion by one linear layer."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vlgs.fusion import require_channels
from vlgs.fusion.blocks import from_blocks, linear, to_blocks


class MLP(nn.Module):
    """Mix the channels of one Gaussian by a single linear layer (the MLP row of Table 4).

    With x = c (+) f: ``u = x + Linear(x)``, or ``u = Linear(x)`` without the residual; the paper does not say which
    (conf/README.md, D.6). The residual layer starts at zero, so that training starts from `NoFusion`; the plain one at Xavier's
    uniform weights.

    Args:
        color_dim: Channels of colour d_c.
        feature_dim: Channels of language d_f.
        residual: Whether the input is added to the output.

    Raises:
        ValueError: If a width is not positive.

    Example:
        >>> color, feature = MLP(color_dim=3, feature_dim=3)(torch.rand(10, 3), torch.rand(10, 3))
        >>> color.shape, feature.shape
        (torch.Size([10, 3]), torch.Size([10, 3]))
    """

    def __init__(self, color_dim: int, feature_dim: int, residual: bool = True):
        super().__init__()
        if min(color_dim, feature_dim) < 1:
            raise ValueError(
                f"MLP: color_dim and feature_dim must be positive, got {color_dim}, {feature_dim}"
            )
        self.widths = (color_dim, feature_dim)
        self.residual = residual
        self.mix = nn.Linear(sum(self.widths), sum(self.widths))
        if residual:
            nn.init.zeros_(self.mix.weight)
        else:
            nn.init.xavier_uniform_(self.mix.weight)
        nn.init.zeros_(self.mix.bias)

    def forward(
        self, color: Float[Tensor, "n dc"], feature: Float[Tensor, "n df"]
    ) -> tuple[Float[Tensor, "n dc"], Float[Tensor, "n df"]]:
        """Fuse n Gaussians at once; see `vlgs.fusion.Fusion`."""
        require_channels("MLP", color, feature, self.widths)
        mixed = linear(self.mix, to_blocks(torch.cat([color, feature], dim=-1)))
        d_color, d_feature = from_blocks(mixed, len(color)).split(self.widths, dim=-1)
        return (color + d_color, feature + d_feature) if self.residual else (d_color, d_feature)
