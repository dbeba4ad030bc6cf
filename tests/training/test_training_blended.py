import pytest
import torch

from vlgs.data.sampler import PairSampler
from vlgs.geometry import pose_matrix, quat_to_rotmat
from vlgs.objectives.between import AHEAD, CamerasBetween
from vlgs.types import Camera
from vlgs.view_blend import BetaBlend, blend_camera


def cameras_between(wide: int) -> CamerasBetween:
    """Five views, the last `wide` of which are wider than the others."""
    g = torch.Generator().manual_seed(0)
    quats, centers = torch.randn(5, 4, generator=g), torch.randn(5, 3, generator=g)
    viewmats = pose_matrix(quat_to_rotmat(quats), centers)
    K = torch.tensor([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]])
    cameras = [Camera(v, K, 8 if i < 5 - wide else 9, 6) for i, v in enumerate(viewmats)]
    sampler = PairSampler(tuple((c.width, c.height) for c in cameras), seed=1)
    return CamerasBetween(sampler, cameras, BetaBlend())


@pytest.mark.parametrize("wide", [0, 1, 2])  # 1: that view is paired with itself
def test_a_blended_camera_is_a_function_of_the_step(wide: int):
    between = cameras_between(wide)
    for step in (3, AHEAD + 1, 0, 2, 5 * AHEAD, AHEAD - 1, AHEAD):  # as after a resume, too
        first, second = between.sampler.pair(step)
        k, camera = between.at(step)
        assert k == between.blend.draw(between.sampler.ratio_rng(step))
        cameras = between.cameras[first], between.cameras[second]
        assert torch.equal(camera.viewmat, blend_camera(*cameras, k, between.blend).viewmat)
        assert torch.equal(camera.viewmat, cameras_between(wide).at(step)[1].viewmat)
