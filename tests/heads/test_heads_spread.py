import pytest
import torch
from slow import with_slow
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.heads.spread import spread_codes


def things(
    count: int, width: int = 64, masks: int = 12, noise: float = 0.3
) -> tuple[Tensor, Tensor]:
    """Noisy embeddings of things that differ alike, and which is of which."""
    generator = torch.Generator().manual_seed(count)
    which = torch.arange(count).repeat(masks)
    common = normalize(torch.randn(1, width, generator=generator))
    means = normalize(common + torch.eye(count, width))
    spoilt = noise * normalize(torch.randn(len(which), width, generator=generator))
    return normalize(means[which] + spoilt), which


def nearest(codes: Tensor) -> float:
    """Degrees between the two nearest codes."""
    cosines = codes @ codes.T - 3 * torch.eye(len(codes))
    return torch.rad2deg(torch.acos(cosines.max().clamp(-1, 1))).item()


@pytest.mark.parametrize(
    ("count", "degrees"), [(2, 180.0), (3, 120.0), (4, 109.47), (6, 90.0), (12, 63.43)]
)
def test_things_that_differ_alike_take_the_corners_of_a_regular_solid(count, degrees):
    vectors, which = things(count, masks=1, noise=0.0)
    codes = spread_codes(vectors, count, 3, seed=0)
    assert nearest(codes[which.argsort()]) == pytest.approx(degrees, abs=1.5)


@pytest.mark.parametrize("seed", range(4))
def test_no_two_of_fifteen_things_share_a_place_whatever_the_seed(seed):
    vectors, which = things(15)
    codes = spread_codes(vectors, 32, 3, seed)
    means = torch.stack([codes[which == k].mean(dim=0) for k in range(15)])
    torch.testing.assert_close(codes.norm(dim=1), torch.ones(len(codes)))
    assert nearest(normalize(means, dim=1)) > 30  # at most 53: fifteen points on a sphere


def test_what_hardly_differs_may_be_near_and_makes_room_for_what_does():
    ends = torch.eye(3, 16)
    vectors = normalize(torch.cat([ends, ends[:1] + 0.02 * torch.eye(16)[5]]))
    codes = spread_codes(vectors, 4, 2, seed=0)
    assert nearest(codes[:3]) > 90
    twin = codes[3] @ codes[:3].T
    assert twin.argmax() == 0


def test_the_same_seed_gives_the_same_bits_and_leaves_the_global_generator_alone():
    vectors, _ = things(7)
    before = torch.get_rng_state()
    first, again = (spread_codes(vectors, 16, 3, seed=5) for _ in range(2))
    assert torch.equal(first, again)
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("dim", with_slow([1, 3, 8], [1, 8]))
@pytest.mark.parametrize("rows", [1, 2, 5])
def test_fewer_embeddings_than_clusters_have_finite_codes(rows, dim):
    vectors = normalize(torch.randn(rows, 32, generator=torch.Generator().manual_seed(rows)))
    codes = spread_codes(vectors, 32, dim, seed=0)
    assert codes.shape == (rows, dim)
    torch.testing.assert_close(codes.norm(dim=1), torch.ones(rows))
