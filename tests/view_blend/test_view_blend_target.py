import jaxtyping
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vlgs.view_blend import UniformBlend, blend_targets

A, B = torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0])
NAN = torch.full((2,), float("nan"))
VALID1 = torch.tensor([[True, True, False, False]])
VALID2 = torch.tensor([[True, False, True, False]])


def maps() -> tuple[torch.Tensor, torch.Tensor]:
    """One row of four pixels: both views, view 1 only, view 2 only, none; NaN where there is no code."""
    return torch.stack([A, A, NAN, NAN])[None], torch.stack([B, NAN, B, NAN])[None]


def test_and_mixes_where_both_views_have_a_code():
    codes1, codes2 = maps()
    target, valid = blend_targets(codes1, VALID1, codes2, VALID2, 0.75, UniformBlend())
    assert valid.tolist() == [[True, False, False, False]]
    assert target[0, 0].tolist() == [0.75, 0.25]


def test_or_takes_the_code_that_is_there():
    codes1, codes2 = maps()
    target, valid = blend_targets(codes1, VALID1, codes2, VALID2, 0.75, UniformBlend(mask="or"))
    assert valid.tolist() == [[True, True, True, False]]
    assert target[0, :3].tolist() == [[0.75, 0.25], [1.0, 0.0], [0.0, 1.0]]


@given(st.integers(0, 10**6), st.floats(0, 1), st.booleans())
@settings(max_examples=50, deadline=None)
def test_renormalised_unit_codes_are_unit(seed: int, k: float, either: bool):
    g = torch.Generator().manual_seed(seed)
    codes1, codes2 = torch.nn.functional.normalize(torch.randn(2, 3, 4, 5, generator=g), dim=-1)
    valid1, valid2 = torch.rand(2, 3, 4, generator=g) > 0.3
    blend = UniformBlend(renormalise=True, mask="or" if either else "and")
    target, valid = blend_targets(codes1, valid1, codes2, valid2, k, blend)
    torch.testing.assert_close(target[valid].norm(dim=-1), torch.ones(int(valid.sum())))


def test_renormalised_codes_get_the_mixed_length():
    ones = torch.ones(1, 1, dtype=torch.bool)
    codes1, codes2 = torch.tensor([[[3.0, 0.0]]]), torch.tensor([[[0.0, 1.0]]])
    target, _ = blend_targets(codes1, ones, codes2, ones, 0.5, UniformBlend(renormalise=True))
    want = 2.0 * torch.tensor([[[1.5, 0.5]]]) / 2.5**0.5
    torch.testing.assert_close(target, want)


def test_opposite_codes_cancel_to_zero():
    ones = torch.ones(1, 1, dtype=torch.bool)
    target, _ = blend_targets(
        A[None, None], ones, -A[None, None], ones, 0.5, UniformBlend(renormalise=True)
    )
    assert target.flatten().tolist() == [0.0, 0.0]


@pytest.mark.parametrize("mask", ["and", "or"])
def test_ends_are_the_maps_to_the_bit(mask):
    codes1, codes2 = torch.randn(2, 5, 7, 3)
    valid1, valid2 = torch.rand(2, 5, 7) > 0.5
    for k, codes in ((1.0, codes1), (0.0, codes2)):
        target, _ = blend_targets(codes1, valid1, codes2, valid2, k, UniformBlend(mask=mask))
        both = valid1 & valid2
        assert torch.equal(target[both], codes[both])


@pytest.mark.parametrize("mask", ["and", "or"])
def test_swapping_the_views_changes_nothing(mask):
    codes1, codes2 = torch.randn(2, 5, 7, 3)
    valid1, valid2 = torch.rand(2, 5, 7) > 0.5
    blend = UniformBlend(mask=mask, renormalise=True)
    target, valid = blend_targets(codes1, valid1, codes2, valid2, 0.3, blend)
    swapped, swapped_valid = blend_targets(codes2, valid2, codes1, valid1, 0.7, blend)
    assert torch.equal(valid, swapped_valid)
    torch.testing.assert_close(target[valid], swapped[valid])


def test_maps_of_two_sizes_are_refused(monkeypatch: pytest.MonkeyPatch):
    # The run-time types would speak first.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    valid = torch.ones(2, 3, dtype=torch.bool)
    with pytest.raises(ValueError, match="blend_targets: both maps and masks must have one size"):
        blend_targets(
            torch.zeros(2, 3, 4), valid, torch.zeros(3, 2, 4), valid.T, 0.5, UniformBlend()
        )
