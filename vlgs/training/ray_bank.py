"""The pixels of all training views, from which rays are drawn."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.fields.radiance import nearest_of
from vlgs.fields.rays import Rays, nearest_seen
from vlgs.geometry import camera_center
from vlgs.types import View


@dataclass(frozen=True)
class Drawn:
    """Some pixels."""

    rays: Rays
    pixels: Int[Tensor, " r"]
    """Their places among those of all views, one view after the other, row by row."""
    views: Int[Tensor, " r"]


class RayBank:
    """Rays of all pixels of some views.

    Args:
        views: At least one.
        points: On surfaces; see `vlgs.fields.radiance.Frame.points`.

    Raises:
        ValueError: If no pixel of them is covered by a photograph.
    """

    def __init__(self, views: Sequence[View], points: Float[Tensor, "p 3"]) -> None:
        cameras = [view.camera for view in views]
        viewmats = torch.stack([camera.viewmat for camera in cameras]).float()
        self.rotations = viewmats[:, :3, :3]
        self.centers = camera_center(viewmats)
        self.K = torch.stack([camera.K for camera in cameras]).float()
        self.widths = torch.tensor([camera.width for camera in cameras])
        self.heights = torch.tensor([camera.height for camera in cameras])
        self.nearest = torch.stack([nearest_seen(camera, points) for camera in cameras]).float()
        sizes = torch.tensor([camera.width * camera.height for camera in cameras])
        self.ends = sizes.cumsum(0)
        self.starts = self.ends - sizes
        masks = [view.read_valid and view.read_valid() for view in views]
        self.covered = None
        if any(mask is not None for mask in masks):
            full = [
                torch.ones(n) if m is None else m
                for n, m in zip(sizes.tolist(), masks, strict=True)
            ]
            self.covered = torch.cat([mask.flatten().bool() for mask in full]).nonzero()[:, 0]
        if self.count == 0:
            raise ValueError(
                "train: training views must have pixels that a photograph covers, got none"
            )

    @property
    def count(self) -> int:
        """Pixels that may be drawn."""
        return int(self.ends[-1]) if self.covered is None else len(self.covered)

    def draw(self, rays: int, generator: torch.Generator) -> Drawn:
        """Pixels drawn evenly from all views."""
        pixels = torch.randint(self.count, (rays,), generator=generator)
        return self.at(pixels if self.covered is None else self.covered[pixels])

    def at(self, pixels: Int[Tensor, " r"]) -> Drawn:
        """Pixels by their places among all."""
        views = torch.searchsorted(self.ends, pixels, right=True)
        within, width = pixels - self.starts[views], self.widths[views]
        K = self.K[views]
        x = (within % width + 0.5 - K[:, 0, 2]) / K[:, 0, 0]
        y = (within // width + 0.5 - K[:, 1, 2]) / K[:, 1, 1]
        ahead = torch.stack([x, y, torch.ones_like(x)], dim=-1)
        directions = (ahead[:, None] @ self.rotations[views])[:, 0]
        near = nearest_of(self.nearest[views], width, self.heights[views], within)
        rays = Rays(self.centers[views], normalize(directions, dim=-1), near)
        return Drawn(rays, pixels, views)


def pixels_of(views: Sequence[View]) -> UInt8[Tensor, "p 3"]:
    """Photographs as `RayBank` counts their pixels, in 8 bits."""
    return torch.cat([view.read_image().flatten(0, 1) for view in views])
