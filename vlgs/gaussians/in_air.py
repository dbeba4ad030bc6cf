"""Gaussians that hang in the air before cameras, where only language sees them.

They are nearer to a training camera than the nearest sparse point that it sees, and so faint that colour does not see them. Language does, as its
weight is another: over large areas codes are constant, so that they fit as well on a sheet before a few cameras, and from between those it
hides the scene. A few dozen of them cost a room 3 to 5 points of mIoU.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.gaussians.init import in_view
from vlgs.geometry import camera_center
from vlgs.types import Camera, Scene


class Air:
    """The space before the training cameras in which nothing is.

    Args:
        scene: Its training cameras and sparse points.
    """

    def __init__(self, scene: Scene) -> None:
        self.cameras = [view.camera for view in scene.train]
        points = scene.points.float()
        points = points[points.isfinite().all(dim=1)]
        self.reach = [_nearest(points, camera) for camera in self.cameras]

    @torch.no_grad()
    def __call__(self, means: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Which centres a camera sees nearer than any sparse point."""
        found = torch.zeros(len(means), dtype=torch.bool)
        for camera, reach in zip(self.cameras, self.reach, strict=True):
            center = camera_center(camera.viewmat).float()
            found |= in_view(means, camera) & ((means - center).norm(dim=1) < reach)
        return found


def _nearest(points: Float[Tensor, "n 3"], camera: Camera) -> float:
    """Distance from a camera to the nearest of the points that it sees; 0 where it sees none, as nothing is known then."""
    seen = points[in_view(points, camera)]
    distances = (seen - camera_center(camera.viewmat).float()).norm(dim=1)
    return float(distances.amin()) if len(distances) else 0.0
