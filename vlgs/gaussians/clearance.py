"""The empty space before the cameras: a Gaussian in it is fog.

What a camera sees nearer than its nearest sparse point is next to certainly air. Colour seldom leaves anything there. Language does: over large
areas its codes are constant, so that they fit as well on a sheet before a few cameras, which colour cannot correct, as it is too
faint to be seen in it; and from between those cameras it hides the scene.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.gaussians.init import in_view
from vlgs.geometry import camera_center
from vlgs.types import Scene

MAX_VIEWS = 64
"""Views that are asked, evenly chosen."""


class Clearance:
    """How far the training cameras see nothing.

    Args:
        scene: Its training views and sparse points.
        share: Of the distance to the nearest sparse point that a camera sees; nothing is known of one that sees none.
    """

    def __init__(self, scene: Scene, share: float) -> None:
        points = scene.points.float()
        points = points[points.isfinite().all(dim=1)]
        self.cameras, self.reach = [], []
        for view in scene.train[:: -(-len(scene.train) // MAX_VIEWS)] if share > 0 else []:
            seen = points[in_view(points, view.camera)]
            if len(seen) > 0:
                distances = (seen - camera_center(view.camera.viewmat).float()).norm(dim=1)
                self.cameras.append(view.camera)
                self.reach.append(share * distances.amin())

    @torch.no_grad()
    def intruders(self, means: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Which centres a camera sees nearer than it can see anything."""
        found = torch.zeros(len(means), dtype=torch.bool)
        for camera, reach in zip(self.cameras, self.reach, strict=True):
            near = (means - camera_center(camera.viewmat).float()).norm(dim=1) < reach
            found |= near & in_view(means, camera)
        return found
