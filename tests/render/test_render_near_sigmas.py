"""What reaches the plane of a camera is left out: whom it takes, against the reference, and the fog that it is there for."""

from dataclasses import replace

import pytest
import torch
from render_scenes import RenderScene, camera_at_origin, random_splats, render
from test_render_agreement import assert_agree
from torch import Tensor

from vlgs.types import RasterConfig, Rendered


def drawn(splats: RenderScene, sigmas: float = 0.0) -> Rendered:
    return render(splats, config=RasterConfig(near_sigmas=sigmas))[0]


def deviations(splats: RenderScene) -> Tensor:
    """Depth over the standard deviation along the view axis, by the covariance in the camera's axes."""
    q = splats.quats / splats.quats.norm(dim=1, keepdim=True)
    w, v = q[:, :1], q[:, 1:]
    basis = torch.eye(3).double().expand(len(q), 3, 3)
    # Columns: the unit vectors turned by the quaternion, v + 2 a x (a x v + w v).
    a, turn = v[:, None, :].expand(-1, 3, -1), w[:, None, :]
    turned = basis + 2 * torch.linalg.cross(a, torch.linalg.cross(a, basis) + turn * basis)
    axes = splats.viewmat[:3, :3] @ turned.transpose(1, 2) @ torch.diag_embed(splats.scales)
    covariance = axes @ axes.transpose(1, 2)
    depth = splats.means @ splats.viewmat[2, :3] + splats.viewmat[2, 3]
    return depth / covariance[:, 2, 2].sqrt()


@pytest.mark.parametrize("sigmas", [0.5, 1.0, 2.5])
def test_it_takes_those_and_agrees_with_the_reference(sigmas: float):
    taken = 0
    for seed in range(12):
        plain = random_splats(40, seed)
        splats = replace(plain, scales=4 * plain.scales)
        assert_agree(splats, RasterConfig(near_sigmas=sigmas))
        all_of_them, kept = (drawn(splats, s).mean2d.abs().sum(dim=1) > 0 for s in (0.0, sigmas))
        assert torch.equal(kept, all_of_them & (deviations(splats) > sigmas))
        taken += int((all_of_them & ~kept).sum())
    assert taken > 5


def far_away(position: list[float]) -> RenderScene:
    """A part of a background: as large as a third of its distance."""
    viewmat, K = camera_at_origin()
    return RenderScene(
        means=torch.tensor([position]).double(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).double(),
        scales=torch.full((1, 3), 14.5).double(),
        weights=(torch.tensor([0.99]).double(),),
        values=(torch.ones(1, 3).double(),),
        viewmat=viewmat,
        K=K,
    )


def test_what_stands_far_to_the_side_is_no_fog_and_what_stands_ahead_is_drawn_as_before():
    aside = far_away([44.0, 0.0, 2.2])  # 87 degrees off the axis, where the image ends at 35
    assert drawn(aside).alphas[0].min() > 0.05
    assert drawn(aside, 1.0).alphas[0].max() == 0
    for ahead in ([0.0, 0.0, 44.0], [30.0, 10.0, 32.0]):
        one, other = drawn(far_away(ahead)), drawn(far_away(ahead), 1.0)
        assert one.alphas[0].max() > 0.1
        assert torch.equal(one.alphas[0], other.alphas[0])
