"""Gaussians that stand where training cannot correct them.

Out of view: no training image has the centre in it. One that reaches into the margin of a view is fitted to a few pixels, and what the
views do not see of it stands before whoever looks from elsewhere.

In the air: nearer to a training camera than the nearest sparse point that it sees, and so faint that colour does not see it. Language does,
as its weight is another: over large areas codes are constant, so that they fit as well on a sheet before a few cameras, and from between
those it hides the scene.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.gaussians.densify import BACKGROUND
from vlgs.gaussians.init import distance_to_nearest, in_view
from vlgs.geometry import camera_center, scene_extent
from vlgs.types import Camera, Scene


class Strays:
    """Finds them; a background, `BACKGROUND` scene extents away from every camera, may be out of view.

    Args:
        scene: Its training cameras and sparse points.
    """

    def __init__(self, scene: Scene) -> None:
        self.cameras = [view.camera for view in scene.train]
        viewmats = torch.stack([camera.viewmat for camera in self.cameras])
        self.centers = camera_center(viewmats).float()
        self.far = BACKGROUND * scene_extent(viewmats)
        points = scene.points.float()
        points = points[points.isfinite().all(dim=1)]
        self.reach = [_nearest(points, camera) for camera in self.cameras]

    @torch.no_grad()
    def __call__(
        self, means: Float[Tensor, "n 3"], faint: Bool[Tensor, " n"]
    ) -> Bool[Tensor, " n"]:
        """Which Gaussians are out of view, or in the air and faint.

        Args:
            means: Centres.
            faint: Whether colour cannot see them.
        """
        lost = distance_to_nearest(means, self.centers) < self.far
        for camera in self.cameras:
            lost &= ~in_view(means, camera)
        return lost | self.in_air(means, faint)

    @torch.no_grad()
    def in_air(self, means: Float[Tensor, "n 3"], faint: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """Which faint Gaussians a camera sees nearer than any sparse point."""
        found = torch.zeros(len(means), dtype=torch.bool)
        for camera, center, reach in zip(self.cameras, self.centers, self.reach, strict=True):
            found |= in_view(means, camera) & ((means - center).norm(dim=1) < reach)
        return found & faint


def _nearest(points: Float[Tensor, "n 3"], camera: Camera) -> float:
    """Distance from a camera to the nearest of the points that it sees; 0 where it sees none, as nothing is known then."""
    seen = points[in_view(points, camera)]
    distances = (seen - camera_center(camera.viewmat).float()).norm(dim=1)
    return float(distances.amin()) if len(distances) else 0.0
