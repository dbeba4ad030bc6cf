"""Cosines and the two queries: hand-worked values, literal formulas, zero vectors, chunks."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vlgs.fields.similarity import cosines, decoded_cosines
from vlgs.queries import LerfRelevancy, Query, VocabSoftmax

QUERIES = (LerfRelevancy(), VocabSoftmax(), VocabSoftmax(negatives=("object",)))


def vectors(rows: int, seed: int, width: int = 8) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    x = torch.randn(rows, width, generator=rng, dtype=torch.float64)
    return torch.nn.functional.normalize(x, dim=-1)


def test_cosines_do_not_depend_on_length():
    features, text = vectors(5, 0), vectors(3, 1)
    want = text @ features.T
    torch.testing.assert_close(cosines(7 * features, text * 0.01), want)


def test_cosines_keep_the_shape_of_a_map():
    got = cosines(vectors(6, 0).reshape(2, 3, 8), vectors(4, 1))
    assert got.shape == (4, 2, 3)
    assert cosines(vectors(1, 0)[0], vectors(4, 1)).shape == (4,)


def test_zero_and_denormal_features_have_cosine_zero_and_finite_gradient():
    features = torch.stack([torch.zeros(8), torch.full((8,), 1e-40)]).requires_grad_()
    got = cosines(features, vectors(3, 1).float())
    got.sum().backward()
    assert got.abs().max() < 1e-30
    assert features.grad is not None
    assert features.grad.isfinite().all()
    assert (cosines(vectors(2, 0), torch.zeros(1, 8)) == 0).all()


def test_cosines_refuse_another_embedding_space():
    with pytest.raises(ValueError, match=r"as wide as the decoded features \(8\), got 7"):
        cosines(vectors(2, 0), vectors(2, 0, width=7))


@pytest.mark.parametrize("chunk", [1, 5, 12, 100])
def test_decoding_in_chunks_changes_nothing(chunk: int):
    weight = vectors(3, 2).float()
    codes = torch.randn(3, 4, 3, generator=torch.Generator().manual_seed(0))
    text = vectors(5, 3).float()
    sizes = []

    def decode(codes: torch.Tensor) -> torch.Tensor:
        sizes.append(len(codes))
        return torch.relu(codes @ weight)

    got = decoded_cosines(decode, codes, text, chunk)
    torch.testing.assert_close(got, cosines(torch.relu(codes @ weight), text))
    assert max(sizes) <= chunk
    assert sum(sizes) >= 12


def test_lerf_relevancy_by_hand():
    # cos+ = 0.3; negatives 0.1 and 0.2: against 0.2 it is exp(3) / (exp(3) + exp(2)) = 1 / (1 + 1/e).
    got = LerfRelevancy().relevancy(torch.tensor([[0.3]]), torch.tensor([[0.1], [0.2]]))
    assert got.item() == pytest.approx(1 / (1 + math.exp(-1)), abs=1e-6)


def test_lerf_relevancy_is_the_minimum_of_pairwise_softmaxes():
    features, text, negatives = vectors(20, 0), vectors(3, 1), vectors(4, 2)
    up, down = torch.exp(10 * text @ features.T), torch.exp(10 * negatives @ features.T)
    want = (up[:, None] / (up[:, None] + down)).amin(dim=1)
    torch.testing.assert_close(LerfRelevancy()(features, text, negatives), want)


def test_lerf_relevancy_of_a_tie_and_of_nothing_is_one_half():
    text = vectors(2, 0)
    assert LerfRelevancy()(text[0], text[:1], text[:1]).item() == 0.5
    assert (LerfRelevancy()(torch.zeros(3, 8).double(), text, vectors(4, 1)) == 0.5).all()


def test_vocab_softmax_is_the_papers_formula():
    features, text = vectors(20, 0), vectors(5, 1)
    likelihood = torch.exp(text @ features.T)
    got = VocabSoftmax()(features, text, torch.empty(0, 8).double())
    torch.testing.assert_close(got, likelihood / likelihood.sum(dim=0))
    torch.testing.assert_close(got.sum(dim=0), torch.ones(20, dtype=torch.float64))


def test_vocab_softmax_negatives_join_the_denominator():
    features, text = vectors(20, 0), vectors(5, 1)
    got = VocabSoftmax(negatives=("object",))(features, text[:4], text[4:])
    torch.testing.assert_close(got, VocabSoftmax()(features, text, text[:0])[:4])


@given(temperature=st.floats(1e-3, 1e6), seed=st.integers(0, 100))
def test_relevancy_is_finite_at_any_temperature(temperature: float, seed: int):
    features, text = vectors(10, seed).float(), vectors(3, seed + 1).float()
    for query in (LerfRelevancy(temperature), VocabSoftmax(temperature)):
        got = query(features, text, vectors(4, seed + 2).float())
        assert got.isfinite().all()
        assert got.min() >= 0
        assert got.max() <= 1


@pytest.mark.parametrize("query", QUERIES)
def test_queries_keep_the_contract(query: Query):
    assert isinstance(query, Query)
    got = query(vectors(6, 0).reshape(2, 3, 8), vectors(4, 1), vectors(2, 2))
    assert got.shape == (4, 2, 3)


@pytest.mark.parametrize("query", QUERIES)
def test_argmax_over_prompts_is_that_of_the_cosines(query: Query):
    features, text = vectors(50, 0), vectors(4, 1)
    got = query(features, text, vectors(2, 2)).argmax(dim=0)
    assert torch.equal(got, cosines(features, text).argmax(dim=0))


@pytest.mark.parametrize("temperature", [0.0, -1.0, math.inf, math.nan])
def test_temperature_must_be_positive(temperature: float):
    for query in (LerfRelevancy, VocabSoftmax):
        with pytest.raises(ValueError, match="temperature must be above 0"):
            query(temperature=temperature)


def test_lerf_relevancy_needs_negatives():
    with pytest.raises(ValueError, match="negatives must be at least one word"):
        LerfRelevancy(negatives=())
