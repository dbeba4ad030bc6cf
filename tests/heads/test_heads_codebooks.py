"""Heads with a table of embeddings: LangSplatV2's codebook, GOI's look-up table, LEGaussians' quantiser; and the clusters that start them."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from vlgs.heads import Head
from vlgs.heads.clusters import clusters
from vlgs.heads.codebook import Codebook
from vlgs.heads.lookup import LookupTable
from vlgs.heads.quantised import QuantisedCodes, QuantiserTraining, quantise, quantiser_loss
from vlgs.heads.rows import linear_rows
from vlgs.objectives.choice import choose

WIDTH = 16


def things(count: int = 5, each: int = 8, spread: float = 0.05) -> Tensor:
    """Unit embeddings of a few things that share a direction, as CLIP's do, with noise."""
    generator = torch.Generator().manual_seed(0)
    middle = 0.7 + torch.randn(count, WIDTH, generator=generator)
    noise = spread * torch.randn(count, each, WIDTH, generator=generator)
    return normalize(middle[:, None] + noise, dim=-1).flatten(0, 1)


def test_clusters_are_the_things_and_follow_from_the_seed_alone():
    vectors = things()
    before = torch.get_rng_state()
    centers = clusters(vectors, 5, seed=3)
    assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(centers, clusters(vectors, 5, seed=3))
    assert not torch.equal(centers, clusters(vectors, 5, seed=4))  # in another order
    nearest = (vectors @ centers.T).argmax(dim=1).view(5, 8)
    assert all(len(row.unique()) == 1 for row in nearest)
    assert len(nearest[:, 0].unique()) == 5
    means = normalize(vectors.view(5, 8, -1).mean(dim=1), dim=-1)
    torch.testing.assert_close(centers[nearest[:, 0]], means)


def test_clusters_need_no_thread_and_no_enough_vectors():
    vectors = things(count=2, each=2)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = clusters(vectors, 7)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(one, clusters(vectors, 7))
    # Every vector is a centre, some more than once.
    assert (one @ vectors.T).amax(dim=0).min() > 1 - 1e-6
    assert (one @ vectors.T).amax(dim=1).min() > 1 - 1e-6
    with pytest.raises(ValueError, match="vectors must be finite and at least 1, got 0"):
        clusters(vectors[:0], 2)


def test_maps_of_many_rows_have_the_same_bits_on_any_number_of_threads():
    rows, weight, bias = torch.randn(3000, 10), torch.randn(300, 10), torch.randn(300)
    torch.testing.assert_close(linear_rows(rows, weight, bias), rows @ weight.T + bias)
    torch.testing.assert_close(linear_rows(rows[:1, None], weight), (rows[:1] @ weight.T)[:, None])
    assert linear_rows(rows[:0], weight, bias).shape == (0, 300)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            r, w, b = inputs = [value.clone().requires_grad_() for value in (rows, weight, bias)]
            error, _ = choose(r, w, b, torch.arange(3000) % 300)
            found.append(torch.autograd.grad(error + linear_rows(r, w, b).sum(), inputs))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))  # fmt: skip


def test_the_codebook_of_langsplat_v2():
    head = Codebook()
    assert isinstance(head, Head)
    assert [tuple(p.shape) for p in head.parameters()] == [(64, 512)]
    assert head.learning_rate == 2.5e-3
    small, vectors = Codebook(dim=5, width=WIDTH), things()
    small.fit(vectors, torch.ones(len(vectors)))
    torch.testing.assert_close(small.entries.norm(dim=1), torch.ones(5))
    assert torch.equal(small.targets(vectors), vectors)
    weights = torch.tensor([0.0, 0.25, 0.0, 0.75, 0.0])
    want = 0.25 * small.entries[1] + 0.75 * small.entries[3]
    torch.testing.assert_close(small.predict(weights), want)
    torch.testing.assert_close(small.decode(weights), normalize(want, dim=-1))
    with pytest.raises(ValueError, match="width must be the embedding width 16, got 512"):
        head.fit(vectors, torch.ones(len(vectors)))


def test_the_table_of_goi_answers_one_of_300_rows():
    head = LookupTable()
    assert isinstance(head, Head)
    shapes = {name: tuple(p.shape) for name, p in head.named_parameters()}
    assert shapes == {"table": (300, 512), "map.weight": (300, 10), "map.bias": (300,)}
    assert head.learning_rate == {"map": 3e-3, "table": 1e-3}
    small, vectors = LookupTable(dim=2, rows=5, width=WIDTH), things()
    small.fit(vectors, torch.ones(len(vectors)))
    with torch.no_grad():
        small.table.mul_(3)  # rows of any length answer at unit length
        codes = torch.randn(20, 2)
        row = (codes @ small.map.weight.T + small.map.bias).argmax(dim=1)
        torch.testing.assert_close(small.decode(codes), small.table[row] / 3)


def test_the_quantiser_of_legaussians():
    head = QuantisedCodes()
    assert isinstance(head, Head)
    layers = [tuple(p.shape) for p in head.parameters()]
    assert layers == [(128, 8), (128,), (256, 128), (256,), (32, 256), (32,)]
    assert head.codebook.shape == (32, 512)  # no parameter: it stays as it was fitted
    small = QuantisedCodes(dim=2, entries=6, width=WIDTH, quantiser=QuantiserTraining(steps=400, learning_rate=1e-3))  # fmt: skip
    vectors = things()
    small.fit(vectors, torch.ones(len(vectors)))
    targets = small.targets(vectors)
    torch.testing.assert_close(targets.sum(dim=1), torch.ones(len(vectors)))
    nearest = targets.argmax(dim=1)
    assert (small.codebook[nearest] * vectors).sum(dim=1).mean() > 0.9
    assert len(nearest.unique()) > 1
    codes = torch.randn(7, 2)
    odds = small.predict(codes).softmax(dim=-1)
    torch.testing.assert_close(small.decode(codes), normalize(odds @ small.codebook, dim=-1))
    torch.testing.assert_close(small.predict(codes), small.predict(3 * codes))


def test_the_loss_of_the_quantiser_is_that_of_a_loop():
    generator = torch.Generator().manual_seed(1)
    clip, dino = torch.rand(2, 7, 4, generator=generator).unbind()
    errors, used, odds = 0.0, [0.0] * 4, torch.zeros(4)
    for one, two in zip(clip, dino, strict=True):
        fit = one + 0.5 * two
        best = int(fit.argmax())
        errors += float((1 - one[best]) + 0.5 * (1 - two[best])) / 7
        used[best] += 1 / 7
        odds += torch.tensor([fit.exp()[k] / fit.exp().sum() for k in range(4)]) / 7
    want = errors + 3 * float(torch.tensor(used) @ odds)
    assert quantiser_loss([clip, dino], [1.0, 0.5], 3.0).item() == pytest.approx(want, rel=1e-5)


def test_a_second_embedding_tells_apart_what_the_first_does_not():
    same = things(count=1, each=8).repeat(2, 1)
    second = one_hot(torch.arange(2), 3).float().repeat_interleave(8, dim=0)
    settings, areas = QuantiserTraining(steps=300, learning_rate=3e-3), torch.ones(16)
    books = quantise([same, second], [1.0, 0.5], areas, 4, settings)
    assert [tuple(book.shape) for book in books] == [(4, WIDTH), (4, 3)]
    fit = same @ books[0].T + 0.5 * second @ books[1].T
    assert fit[:8].argmax(dim=1)[0] != fit[8:].argmax(dim=1)[0]
    again = quantise([same, second], [1.0, 0.5], areas, 4, settings)
    assert all(map(torch.equal, books, again))
    with pytest.raises(ValueError, match="areas must be 16, at least 0 and not all 0"):
        quantise([same, second], [1.0, 0.5], torch.zeros(16), 4, settings)
