"""Codes in principal directions: exact where embeddings spread in few, and answers that are as long as sure."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.fields.comparing import Decoding, Folding
from vlgs.heads import Head, lengths_count
from vlgs.heads.identity import Identity
from vlgs.heads.principal import Principal


def masks(count: int = 40, things: int = 5, noise: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
    """Embeddings of so many masks of some things, whose they are, and what things are without noise."""
    generator = torch.Generator().manual_seed(3)
    true = normalize(torch.randn(things, 24, generator=generator), dim=1)
    whose = torch.arange(count) % things
    noisy = true[whose] + noise * torch.randn(count, 24, generator=generator)
    return normalize(noisy, dim=1), whose, true


def fitted(vectors: Tensor, **settings: object) -> Principal:
    head = Principal(**settings)  # type: ignore[arg-type]
    head.fit(vectors, torch.linspace(1, 500, len(vectors)))
    return head


def test_what_spreads_in_few_directions_comes_back_whole():
    vectors, _, _ = masks()
    head = fitted(vectors, dim=8, entries=0)
    assert isinstance(head, Head)
    codes = head.targets(vectors)
    torch.testing.assert_close(head.decode(codes), vectors)
    torch.testing.assert_close(codes.norm(dim=1), torch.ones(len(codes)))
    assert not head.basis[5:].any(), "five things have five directions"
    torch.testing.assert_close(head.basis[:5] @ head.basis[:5].T, torch.eye(5))


def test_the_first_directions_are_those_that_keep_most():
    vectors, _, _ = masks(noise=0.3)
    head = fitted(vectors, dim=3, entries=0, area_power=0.0)
    kept = head.targets(vectors).square().sum()
    best = torch.linalg.svdvals(vectors)[:3].square().sum()
    torch.testing.assert_close(kept, best)


def test_large_masks_count_more_for_the_directions():
    vectors = torch.eye(24)[:2].repeat(20, 1)
    head = Principal(dim=1, entries=0, area_power=1.0)
    head.fit(vectors, torch.tensor([3.0, 1.0]).repeat(20))
    torch.testing.assert_close(head.basis, torch.eye(24)[:1])


def test_an_answer_is_as_long_as_it_is_sure():
    vectors, _, _ = masks()
    head = fitted(vectors, dim=5, entries=4, sure=0.5)
    codes = head.targets(vectors[:1])
    for share, length in ((1.0, 1.0), (0.6, 1.0), (0.25, 0.5), (0.0, 0.0)):
        assert head.decode(share * codes).norm().item() == pytest.approx(length, abs=1e-6)
    words = torch.cat([vectors[:1], -vectors[:1]])
    whole, half, none = (
        Decoding(head)(share * codes[None], words)[:, 0, 0] for share in (1.0, 0.25, 0.0)
    )
    torch.testing.assert_close(half, whole / 2)
    assert not none.any(), "what nothing is known of fits no word"
    assert lengths_count(head)
    assert not lengths_count(Identity(24))


def test_noise_of_single_masks_and_edges_between_things_are_drawn_to_one_thing():
    vectors, whose, true = masks(200, noise=0.12)
    plain, drawn = (fitted(vectors, dim=5, entries=entries) for entries in (0, 12))
    codes = plain.targets(vectors)
    near, nearer = ((head.decode(codes) * true[whose]).sum(1) for head in (plain, drawn))
    assert nearer.mean() > near.mean() + 0.02
    edge = 0.6 * codes[:1] + 0.4 * codes[1:2]  # a pixel on the edge between two things
    assert (plain.decode(edge) @ true.T)[0, :2].min() > 0.5
    assert (drawn.decode(edge) @ true.T)[0, 0] > 0.95


def test_words_are_compared_without_embeddings():
    vectors, _, true = masks(noise=0.1)
    for entries in (0, 5):
        head = fitted(vectors, dim=6, entries=entries)
        codes = torch.linspace(0, 1.2, len(vectors))[:, None] * head.targets(vectors)
        want = Decoding(head)(codes[None], true)
        torch.testing.assert_close(Folding(head.fold())(codes[None], true), want)


def test_weights_come_back_at_any_width_and_threads_change_nothing():
    vectors, _, _ = masks(noise=0.1)
    head = fitted(vectors, dim=6, entries=5)
    other = Principal(dim=6, entries=7)
    other.load_state_dict(head.state_dict())
    codes = head.targets(vectors)
    assert torch.equal(other.decode(codes), head.decode(codes))
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert torch.equal(fitted(vectors, dim=6, entries=5).basis, head.basis)
    finally:
        torch.set_num_threads(threads)


def test_bad_input():
    with pytest.raises(ValueError, match="dim must be 1 to 4096, got 0"):
        Principal(dim=0)
    with pytest.raises(ValueError, match="sure must be 1e-06 to 1, got 0"):
        Principal(sure=0.0)
    with pytest.raises(ValueError, match="dim must be at most the embedding width 3, got 8"):
        Principal(dim=8).fit(torch.ones(2, 3), torch.ones(2))
    with pytest.raises(ValueError, match="finite and at least 1, got 2"):
        Principal(dim=2).fit(torch.full((2, 3), torch.nan), torch.ones(2))
    with pytest.raises(ValueError, match="fit or a state dict must come before"):
        Principal(dim=2).targets(torch.ones(2, 3))
