"""Where a browser looks from, and how photographs' cameras become such a place."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan, tan

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.geometry import camera_center, pose_matrix, quat_to_rotmat, rotmat_to_quat, scene_extent
from vlgs.opened.cameras import focus, upright
from vlgs.types import Camera

_NEAREST = 0.1
"""Least distance to what a camera looks at, in extents of the scene."""


@dataclass(frozen=True)
class Eye:
    """A camera whose pixels are square and whose principal point is the middle of the picture."""

    position: tuple[float, ...]
    wxyz: tuple[float, ...]
    """Rotation from the camera's axes to the world's."""
    fov: float
    """Vertical field of view in radians."""
    width: int
    height: int

    def camera(self, width: int | None = None, height: int | None = None) -> Camera:
        """The same view in pixels of another size, or of its own."""
        w, h = width or self.width, height or self.height
        focal_x, focal_y = (w / self.width, h / self.height)
        focal = self.height / (2 * tan(self.fov / 2))
        K = [[focal * focal_x, 0.0, w / 2], [0.0, focal * focal_y, h / 2], [0.0, 0.0, 1.0]]
        rotation = quat_to_rotmat(torch.tensor(self.wxyz, dtype=torch.float64)).mT
        viewmat = pose_matrix(rotation, torch.tensor(self.position, dtype=torch.float64))
        return Camera(viewmat.float(), torch.tensor(K), w, h)


def eye_of(camera: Camera, width: int, height: int) -> Eye:
    """The eye at a photograph's camera, from which all of the photograph is seen in a window of a size.

    A principal point off the middle cannot be had: the middle of the window looks along the optical axis.
    """
    fx, fy, cx, cy = (float(camera.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    across = max(cx, camera.width - cx) / fx
    down = max(cy, camera.height - cy) / fy
    slope = max(down, across * height / width)
    wxyz = rotmat_to_quat(camera.viewmat[:3, :3].mT.double())
    position = camera_center(camera.viewmat.double())
    return Eye(tuple(position.tolist()), tuple(wxyz.tolist()), 2 * atan(slope), width, height)


def part(camera: Camera, left: int, right: int, top: int = 0, bottom: int | None = None) -> Camera:
    """What a camera sees from one column and row up to others, which may lie outside of its picture."""
    shift = torch.zeros_like(camera.K)
    shift[0, 2], shift[1, 2] = left, top
    height = (camera.height if bottom is None else bottom) - top
    return Camera(camera.viewmat, camera.K - shift, right - left, height)


@dataclass(frozen=True)
class Surroundings:
    """What the cameras of a scene tell of it."""

    up: tuple[float, ...]
    """Away from the ground."""
    focus: Float[Tensor, " 3"]
    """The point that the cameras look at."""
    nearest: float
    """Least distance from a camera at which it is looked for."""

    def look_at(self, camera: Camera) -> tuple[float, ...]:
        """The point in front of a camera around which it is turned."""
        center, axis = camera_center(camera.viewmat), camera.viewmat[2, :3]
        distance = max(float(axis @ (self.focus - center)), self.nearest)
        return tuple((center + distance * axis).tolist())

    def up_of(self, camera: Camera) -> tuple[float, ...]:
        """The axis around which a camera is turned: what is up, tilted only as far as the camera is rolled."""
        up, right = torch.tensor(self.up), camera.viewmat[0, :3]
        tilted = up - (up @ right) * right
        own = -camera.viewmat[1, :3]
        chosen = (
            tilted if tilted @ own > 0.05 else own
        )  # it stands on its head, or looks straight down
        return tuple((chosen / chosen.norm()).tolist())


def surroundings(cameras: Sequence[Camera]) -> Surroundings:
    """What is up, and the point that the optical axes pass nearest to (`vlgs.opened.cameras`)."""
    viewmats = torch.stack([camera.viewmat for camera in cameras]).double()
    target = focus(camera_center(viewmats), viewmats[:, 2, :3])
    up = tuple(upright(viewmats).tolist())
    return Surroundings(up, target.float(), _NEAREST * scene_extent(viewmats))
