import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from slow import with_slow
from torch import Tensor

from vlgs.geometry import camera_center, pose_matrix, quat_to_rotmat
from vlgs.types import Camera
from vlgs.view_blend import BetaBlend, blend_camera, blend_cameras, slerp

SEED = torch.Generator().manual_seed(0)
THRESHOLD = 0.995
"""Above this |cosine| Eq. 9 is a lerp."""
seeds = st.integers(0, 2**31)
ratios = st.floats(0, 1)


def quats(count: int, generator: torch.Generator = SEED) -> Tensor:
    q = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    return q / q.norm(dim=1, keepdim=True)


def apart(count: int, angle: float | Tensor) -> tuple[Tensor, Tensor]:
    """Pairs of unit quaternions with a given angle between them (half the angle of the rotations)."""
    q1, r = quats(count), quats(count)
    r = r - (r * q1).sum(dim=1, keepdim=True) * q1
    angle = torch.as_tensor(angle, dtype=torch.float64).reshape(-1, 1)
    return q1, angle.cos() * q1 + angle.sin() * r / r.norm(dim=1, keepdim=True)


def angle_between(q1: Tensor, q2: Tensor) -> Tensor:
    """Angle on the short arc in radians; accurate near 0, where an arccos is not."""
    same, opposite = (q1 - q2).norm(dim=1), (q1 + q2).norm(dim=1)
    return 2 * torch.atan2(torch.minimum(same, opposite), torch.maximum(same, opposite))


def z_rotation(degrees: float) -> Tensor:
    half = math.radians(degrees) / 2
    return torch.tensor([math.cos(half), 0, 0, math.sin(half)], dtype=torch.float64)


def hostile_pairs() -> tuple[Tensor, Tensor]:
    """A million pairs: random, equal, opposite, 1 ulp apart, 180 degrees apart, and at the paper's threshold."""
    edge = math.acos(THRESHOLD)
    groups = [
        (quats(500_000), quats(500_000)),
        apart(200_000, torch.logspace(-12, 0, 200_000, dtype=torch.float64)),
        apart(100_000, edge + torch.linspace(-1e-6, 1e-6, 100_000, dtype=torch.float64)),
        apart(50_000, math.pi / 2),
    ]
    q = quats(50_000)
    groups += [(q, q), (q, -q), (q, torch.nextafter(q, q + 1))]
    return torch.cat([a for a, _ in groups]), torch.cat([b for _, b in groups])


@pytest.mark.parametrize("k", with_slow([0.0, 1e-9, 0.1, 0.5, 0.9, 1.0], [0.0, 0.1, 0.9, 1.0]))
def test_a_million_pairs_turn_by_their_share_of_the_angle(k: float):
    q1, q2 = hostile_pairs()
    q = slerp(q1, q2, k)
    whole = angle_between(q1, q2)
    assert (q.norm(dim=1) - 1).abs().max() < 1e-12
    assert (angle_between(q1, q) - (1 - k) * whole).abs().max() < 1e-12
    assert (angle_between(q2, q) - k * whole).abs().max() < 1e-12


def test_ends_are_the_inputs():
    q1, q2 = hostile_pairs()
    assert angle_between(slerp(q1, q2, 1.0), q1).max() < 1e-14
    assert angle_between(slerp(q1, q2, 0.0), q2).max() < 1e-14


def test_signs_and_lengths_of_the_inputs_do_not_matter():
    q1, q2 = apart(1000, torch.linspace(0, 1.5, 1000, dtype=torch.float64))
    want = quat_to_rotmat(slerp(q1, q2, 0.3))
    for s1, s2 in ((-1, 1), (1, -1), (-1, -1), (1e-20, 1e20)):
        got = quat_to_rotmat(slerp(s1 * q1, s2 * q2, 0.3))
        torch.testing.assert_close(got, want, rtol=0, atol=1e-14)


@pytest.mark.parametrize("k", [0.2, 0.5, 0.9])
def test_no_jump_at_the_threshold_of_the_paper(k: float):
    edge = math.acos(THRESHOLD)
    q1, below = apart(1, edge - 1e-9)
    above = math.cos(edge + 1e-9) * q1 + math.sin(edge + 1e-9) * (
        (below - math.cos(edge - 1e-9) * q1) / math.sin(edge - 1e-9)
    )
    assert angle_between(slerp(q1, below, k), slerp(q1, above, k)).item() < 1e-8


def test_distance_to_the_papers_lerp_above_its_threshold():
    q1, q2 = apart(1000, torch.linspace(0, math.acos(THRESHOLD), 1000, dtype=torch.float64))
    k = torch.rand(1000, dtype=torch.float64)
    lerp = k[:, None] * q1 + (1 - k[:, None]) * q2
    assert angle_between(slerp(q1, q2, k), lerp / lerp.norm(dim=1, keepdim=True)).max() < 1.7e-5


@pytest.mark.parametrize("degrees", [5, 60, 179])
def test_turns_about_an_axis_by_hand(degrees: float):
    for k in (-0.5, 0.0, 0.25, 1.0, 1.5):
        want = z_rotation((1 - k) * degrees)
        torch.testing.assert_close(slerp(z_rotation(0), z_rotation(degrees), k), want)


def test_papers_formula_swaps_the_views_at_its_threshold():
    """Half a degree more between the views, and the blended one jumps from one end to the other (conf/README.md, D.1)."""
    for apart_by, from_view1 in ((11.0, 1.1), (12.0, 10.8)):
        q = slerp(z_rotation(0), z_rotation(apart_by), 0.9, "paper")
        angle = 2 * angle_between(q[None], z_rotation(0)[None])
        assert math.degrees(angle.item()) == pytest.approx(from_view1, abs=0.01)


def test_papers_formula_by_hand_where_the_signs_differ():
    """cos = -0.6: q1 is flipped but the angle is not, so that the blend is off its share (conf/README.md, D.2)."""
    q1, q2 = z_rotation(0), torch.tensor([-0.6, 0.0, 0.0, 0.8], dtype=torch.float64)
    theta = math.acos(-0.6)
    literal = -q1 * math.sin(0.75 * theta) + q2 * math.sin(0.25 * theta)
    torch.testing.assert_close(slerp(q1, q2, 0.25, "paper"), literal / literal.norm())


@pytest.mark.parametrize("k", with_slow([0.0, 0.3, 1.0], [0.0, 1.0]))
def test_papers_formula_is_finite_everywhere(k: float):
    q = slerp(*hostile_pairs(), k, "paper")
    assert (q.norm(dim=1) - 1).abs().max() < 1e-12
    quarter = torch.tensor([[0.0, 1.0, 0.0, 0.0]])  # cos = 0 exactly: printed as 0/0
    assert slerp(torch.tensor([[1.0, 0.0, 0.0, 0.0]]), quarter, k, "paper").isfinite().all()


def test_float32_is_as_good_as_float32_can_be():
    q1, q2 = (q[::50] for q in hostile_pairs())
    got = slerp(q1.float(), q2.float(), 0.3)
    # Where q1 and q2 are orthogonal, both arcs are the short one: leave those out.
    clear = (q1 * q2).sum(dim=1).abs() > 1e-3
    assert got.isfinite().all()
    assert angle_between(got.double(), slerp(q1, q2, 0.3))[clear].max() < 1e-6


@pytest.mark.parametrize("bad", [0.0, float("nan"), float("inf")])
def test_quaternion_without_direction_is_refused(bad: float):
    with pytest.raises(
        ValueError, match="slerp: lengths of quaternions must be positive and finite"
    ):
        slerp(torch.full((4,), bad), z_rotation(0).float(), 0.5)


def camera(seed: int, dtype: torch.dtype = torch.float64, **sizes: int) -> Camera:
    g = torch.Generator().manual_seed(seed)
    center = torch.randn(3, generator=g, dtype=torch.float64)
    focal = 100 + 50 * torch.rand(2, generator=g, dtype=torch.float64)
    K = torch.tensor([[focal[0], 0, 31.0], [0, focal[1], 25.5], [0, 0, 1]], dtype=torch.float64)
    viewmat = pose_matrix(quat_to_rotmat(quats(1, g)[0]), center)
    return Camera(viewmat.to(dtype), K.to(dtype), sizes.get("width", 64), sizes.get("height", 48))


@given(seeds, seeds, ratios)
@settings(max_examples=50, deadline=None)
def test_blended_camera_is_between_its_views(seed1: int, seed2: int, k: float):
    camera1, camera2 = camera(seed1), camera(seed2)
    got = blend_camera(camera1, camera2, k, BetaBlend())
    rotation = got.viewmat[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), rtol=0, atol=1e-12)
    assert torch.linalg.det(rotation) > 0
    center = k * camera_center(camera1.viewmat) + (1 - k) * camera_center(camera2.viewmat)
    torch.testing.assert_close(camera_center(got.viewmat), center, rtol=0, atol=1e-12)
    torch.testing.assert_close(got.K, k * camera1.K + (1 - k) * camera2.K)
    assert got.viewmat[3].tolist() == [0, 0, 0, 1]

    swapped = blend_camera(camera2, camera1, 1 - k, BetaBlend())
    torch.testing.assert_close(swapped.viewmat, got.viewmat, rtol=0, atol=1e-7)


@given(seeds, seeds, ratios)
@settings(max_examples=25, deadline=None)
def test_moving_the_world_moves_the_blended_camera_with_it(seed1: int, seed2: int, k: float):
    camera1, camera2, world = camera(seed1), camera(seed2), camera(7).viewmat
    moved1, moved2 = (Camera(c.viewmat @ world, c.K, c.width, c.height) for c in (camera1, camera2))
    got = blend_camera(moved1, moved2, k, BetaBlend()).viewmat
    want = blend_camera(camera1, camera2, k, BetaBlend()).viewmat @ world
    torch.testing.assert_close(got, want, rtol=0, atol=1e-7)


def test_ends_are_the_cameras_themselves():
    camera1, camera2 = camera(1), camera(2)
    assert blend_camera(camera1, camera2, 1.0, BetaBlend()) is camera1
    assert blend_camera(camera1, camera2, 0.0, BetaBlend()) is camera2
    assert blend_camera(camera1, camera2, 1.0, BetaBlend(rotation=False)) is camera1


@pytest.mark.parametrize("k", [0.0, 0.3])
def test_a_switch_that_is_off_keeps_view_1(k: float):
    camera1, camera2 = camera(1), camera(2)
    both = blend_camera(camera1, camera2, k, BetaBlend())
    moved = blend_camera(camera1, camera2, k, BetaBlend(rotation=False))
    turned = blend_camera(camera1, camera2, k, BetaBlend(translation=False))
    torch.testing.assert_close(moved.viewmat[:3, :3], camera1.viewmat[:3, :3])
    torch.testing.assert_close(camera_center(moved.viewmat), camera_center(both.viewmat))
    torch.testing.assert_close(turned.viewmat[:3, :3], both.viewmat[:3, :3])
    torch.testing.assert_close(camera_center(turned.viewmat), camera_center(camera1.viewmat))


def test_paper_convention_turns_the_wrong_way_but_moves_the_right_one():
    camera1 = Camera(
        pose_matrix(quat_to_rotmat(z_rotation(0)), torch.zeros(3).double()),
        torch.eye(3).double(),
        4,
        4,
    )
    center = torch.tensor([1.0, 2.0, 3.0]).double()
    camera2 = Camera(
        pose_matrix(quat_to_rotmat(z_rotation(60)), center), torch.eye(3).double(), 4, 4
    )
    got = blend_camera(camera1, camera2, 0.75, BetaBlend(convention="paper"))
    torch.testing.assert_close(got.viewmat[:3, :3], quat_to_rotmat(z_rotation(45)))
    torch.testing.assert_close(camera_center(got.viewmat), center / 4)


def test_raw_ratio_extrapolates_the_pose_but_not_the_lens():
    camera1, camera2 = camera(1), camera(2)
    got = blend_camera(camera1, camera2, 2.0, BetaBlend())
    center1, center2 = camera_center(camera1.viewmat), camera_center(camera2.viewmat)
    torch.testing.assert_close(camera_center(got.viewmat), 2 * center1 - center2)
    assert torch.equal(got.K, camera1.K)


def test_equal_intrinsics_are_kept_to_the_bit_and_the_type_is_kept():
    camera1 = camera(1, torch.float32)
    camera2 = Camera(camera(2, torch.float32).viewmat, camera1.K, 64, 48)
    got = blend_camera(camera1, camera2, 0.37, BetaBlend())
    assert torch.equal(got.K, camera1.K)
    assert got.viewmat.dtype == torch.float32


def test_bad_pairs_are_refused():
    with pytest.raises(
        ValueError, match=r"image sizes must be equal, got \(64, 48\) and \(65, 48\)"
    ):
        blend_camera(camera(1), camera(2, width=65), 0.5, BetaBlend())
    with pytest.raises(ValueError, match="k must be finite, got nan"):
        blend_camera(camera(1), camera(2), float("nan"), BetaBlend())


@pytest.mark.parametrize("convention", ["consistent", "paper"])
@pytest.mark.parametrize("kept", ["first", "nearer"])
@pytest.mark.parametrize(("rotation", "translation"), [(True, True), (True, False), (False, True)])
def test_many_pairs_at_once_are_each_pair_alone_to_the_bit(
    convention, kept, rotation: bool, translation: bool
):
    blend = BetaBlend(rotation=rotation, translation=translation, convention=convention, kept=kept)
    ones = [camera(seed, torch.float32) for seed in range(20)]
    twos = [camera(seed, torch.float32) for seed in range(20, 40)]
    ks = [0.0, 1.0, 0.5, 1e-9, *torch.rand(16, dtype=torch.float64).tolist()]
    together = blend_cameras(ones, twos, ks, blend)
    for one, two, k, got in zip(ones, twos, ks, together, strict=True):
        alone = blend_camera(one, two, k, blend)
        assert torch.equal(got.viewmat, alone.viewmat)
        assert torch.equal(got.K, alone.K)
    assert blend_cameras([], [], [], blend) == []
