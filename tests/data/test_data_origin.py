"""Models in the coordinates of a map: seen from their own midst, and their files still fit."""

import logging
from pathlib import Path

import pytest
import torch
from colmap_scenes import UTM, surveyed, write_scene

from vlgs.data.colmap import load_scene
from vlgs.data.sparse import AT_HOME, moved, origin_of, read_sparse
from vlgs.geometry import camera_center, pose_matrix, quat_to_rotmat, scene_extent


def test_a_map_s_coordinates_lose_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    write_scene(tmp_path / "near")
    near = load_scene(str(tmp_path / "near"))
    with caplog.at_level(logging.WARNING):
        far = load_scene(str(surveyed(tmp_path / "far")))
    assert near.origin == AT_HOME
    assert all(value == round(value, 1) for value in far.origin), "cameras are half a unit apart"
    assert "is subtracted from all positions" in caplog.text
    shift = torch.tensor(UTM, dtype=torch.float64) - torch.tensor(far.origin, dtype=torch.float64)
    assert shift.norm() < 5
    torch.testing.assert_close(far.points.double(), near.points + shift, atol=1e-6, rtol=0)
    for one, other in zip(far.train, near.train, strict=True):
        centers = [camera_center(view.camera.viewmat.double()) for view in (one, other)]
        torch.testing.assert_close(centers[0], centers[1] + shift, atol=2e-6, rtol=0)
    assert far.fingerprint != near.fingerprint


@pytest.mark.parametrize("farther", [False, True])
def test_a_model_is_moved_from_twenty_extents_on(tmp_path: Path, farther: bool):
    write_scene(tmp_path)
    model = read_sparse(tmp_path / "sparse" / "0", ".bin")
    viewmats = torch.stack([image.viewmat() for image in model.images])
    middle, extent = camera_center(viewmats).mean(dim=0), scene_extent(viewmats)
    away = torch.tensor([(20.1 if farther else 19.9) * extent, 0, 0], dtype=torch.float64) - middle
    x, y, z = (-away).tolist()
    assert (origin_of(moved(model, (x, y, z))) != AT_HOME) == farther


def test_cameras_that_only_turn_have_no_extent():
    """-R^T t of one centre differs in its last bits; a rate of 1e-7 would move nothing."""
    quats = torch.tensor([[1.0, 0.1 * i, 0.2 - 0.05 * i, 0.03 * i] for i in range(6)])
    for center in ([0.0, 0, 0], [3.0, 2, 1], [300.0, -20, 1]):
        viewmats = pose_matrix(quat_to_rotmat(quats), torch.tensor(center).expand(6, 3))
        assert scene_extent(viewmats) == 1.0
    apart = torch.tensor([3.0, 2, 1]) + torch.linspace(0, 1e-3, 6)[:, None]
    assert scene_extent(pose_matrix(quat_to_rotmat(quats), apart)) == pytest.approx(
        9.5e-4, rel=0.02
    )
