"""Gaussians that hang in the air before cameras.

Those that only language sees are nearer to a training camera than the nearest sparse point that it sees, and so faint that colour does not see
them. Language does, as its weight is another: over large areas codes are constant, so that they fit as well on a sheet before a few cameras, and
from between those it hides the scene. A few dozen of them cost a room 3 to 5 points of mIoU.

Others stand where a camera that nobody trained on will be: a few pixels wide from the training cameras behind it, they fill its image. In a
street drive whose middle tenth is held out, what is less than 0.3 units before the camera (the nearest sparse points: 0.8) covers 58 % of one view.
No rule can tell them from things seen from afar before the camera is there, hence the near plane.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.gaussians.init import MAX_COORDINATE, distance_to_nearest, in_view
from vlgs.geometry import camera_center
from vlgs.types import Camera, Scene

STRAY_POINTS = 2
"""So many of the points that a camera sees may be errors of measurement, though no more than one in a hundred; the next one counts as the nearest."""
FEWEST_POINTS = 100
"""Fewer points in all do not tell where a scene begins."""


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


@torch.no_grad()
def narrow(
    log_scales: Float[Tensor, "n 3"],
    means: Float[Tensor, "n 3"],
    centers: Float[Tensor, "v 3"],
    most: float,
    near: float,
) -> None:
    """Cut scales down to `most` times the distance to the nearest camera, in place.

    Nothing else holds a Gaussian back where no training view looks: of a background 16 units away, of which two views saw a pixel, one standard deviation
    became 12 units, and a camera between the two saw nothing but it.

    Args:
        log_scales: Natural logarithms, world units.
        means: World units.
        centers: Of the training cameras.
        most: Above 0; at a third, no camera is within three standard deviations.
        near: Depth before which nothing is drawn: what is nearer counts as that far.
    """
    far = distance_to_nearest(means.detach(), centers.to(means)).clamp_min(near)
    log_scales.copy_(torch.minimum(log_scales, (most * far).log()[:, None]))


def near_plane(scene: Scene, share: float) -> float:
    """Depth before which nothing is drawn: a share of that of the nearest thing that any training camera sees, by sparse points.

    It is 0 where there are too few points. What stands before a camera without one sparse point on it, nearer than this, is not drawn either.
    """
    points = scene.points.float()
    points = points[(points.abs() <= MAX_COORDINATE).all(dim=1)]
    if share == 0 or len(points) < FEWEST_POINTS:
        return 0.0
    depths = [_depths(points, view.camera) for view in scene.train]
    nearest = [seen[min(STRAY_POINTS, len(seen) // 100)] for seen in depths if len(seen)]
    return share * float(torch.stack(nearest).amin()) if nearest else 0.0


def _depths(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, " m"]:
    """Of the points that a camera sees, the nearest first."""
    row = camera.viewmat[2].float()
    return (points[in_view(points, camera)] @ row[:3] + row[3]).sort().values


def _nearest(points: Float[Tensor, "n 3"], camera: Camera) -> float:
    """Distance from a camera to the nearest of the points that it sees; 0 where it sees none, as nothing is known then."""
    seen = points[in_view(points, camera)]
    distances = (seen - camera_center(camera.viewmat).float()).norm(dim=1)
    return float(distances.amin()) if len(distances) else 0.0
