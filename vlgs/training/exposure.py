"""What a camera did to one photograph: gain, white balance and offset, learned beside the scene."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


class Exposure(nn.Module):
    """An affine map of RGB per training view, as 3DGS's exposure compensation; their mean is always the identity.

    Without that the scene could become darker while all photographs became brighter, and held-out views, which have no map, would
    show it.

    Args:
        views: Number of training views.
    """

    def __init__(self, views: int) -> None:
        super().__init__()
        self.maps = nn.Parameter(torch.zeros(views, 3, 4))

    def forward(self, index: int, color: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """The colour of a training view as its photograph shows it."""
        own = self.maps[index] - self.maps.mean(dim=0)
        return color + color @ own[:, :3].T + own[:, 3]
