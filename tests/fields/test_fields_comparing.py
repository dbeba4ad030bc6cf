"""Folded and tabulated cosines beside decoded ones, and fields that answer by them."""

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.fields import Field, FieldImages, faster
from vlgs.fields.comparing import (
    REACH,
    CodeTable,
    Comparing,
    Decoding,
    Folding,
    Tabulating,
    comparing,
)
from vlgs.fields.planes import Plane, with_planes
from vlgs.fields.several import SeveralFields
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import ObjectField, SplatField
from vlgs.fusion.none import NoFusion
from vlgs.heads.autoencoder import Autoencoder, AutoencoderTraining
from vlgs.heads.classifier import Classifier
from vlgs.heads.identity import Identity
from vlgs.indicator import Learned
from vlgs.types import Camera, RasterConfig

WIDTH = 16
CAMERA = Camera(torch.eye(4), torch.eye(3), 8, 6)


def codec(dim: int = 3) -> Autoencoder:
    torch.manual_seed(0)
    head = Autoencoder(dim, (8,), (16, 16), training=AutoencoderTraining(steps=60, batch=16))
    head.fit(normalize(torch.randn(12, WIDTH) + 0.5, dim=1), torch.ones(12))
    return head


def in_float64(head: Autoencoder, codes: Tensor, words: Tensor) -> Tensor:
    """Layer by layer, with nothing of the package but the weights."""
    x = codes.double()
    for layer in head.decoder:
        if isinstance(layer, torch.nn.Linear):
            x = x @ layer.weight.double().T + layer.bias.double()
        else:
            x = x * (x > 0)
    x = x + head.mean.double()
    both = x / x.norm(dim=-1, keepdim=True), words.double() / words.double().norm(dim=1)[:, None]
    return (both[0] @ both[1].T).movedim(-1, 0)


def pixels(dim: int = 3, reach: float = 1.0) -> Tensor:
    """Smooth, as rendered codes are."""
    coarse = torch.rand(1, dim, 4, 5, generator=torch.Generator().manual_seed(1)) * 2 - 1
    fine = torch.nn.functional.interpolate(coarse, (60, 80), mode="bilinear", align_corners=True)
    return reach * fine[0].movedim(0, -1).contiguous()


WORDS = torch.randn(5, WIDTH, generator=torch.Generator().manual_seed(2))


@pytest.mark.parametrize("dim", [2, 3, 16])
def test_folding_is_decoding_but_for_rounding(dim: int):
    head, codes = codec(dim), pixels(dim)
    wanted = in_float64(head, codes, WORDS)
    for way in (Decoding(head), Folding(head.fold())):
        assert isinstance(way, Comparing)
        found = way(codes, WORDS).double()
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("within", [0.2, 0.05, 0.02])
def test_a_table_is_off_by_no_more_than_it_says(within: float):
    head, codes = codec(), pixels()
    way = Tabulating(Folding(head.fold()), within)
    wanted = in_float64(head, codes, WORDS)
    found = [way(codes, WORDS) for _ in range(2)]  # while it is filled, and when it is there
    assert found[0].equal(found[1])
    off = (found[0].double() - wanted).abs().max()
    (table,) = way.tables.values()
    assert 0 < table.error <= within
    assert off <= 1.3 * table.error
    assert off > 1e-5, "it is a table"
    assert table.nbytes > table.places.nbytes


def test_narrower_cells_are_more_exact():
    head, codes = codec(), pixels().view(-1, 3)
    folding = Folding(head.fold())
    exact, off = folding.flat(codes, WORDS), []
    for cell in (1 / 8, 1 / 16, 1 / 32):
        table = CodeTable(cell, WORDS)
        assert table.fill(codes, folding, 10**6)
        answers, lacking = table.look_up(codes)
        assert lacking == 0
        off.append(float((answers - exact).abs().max()))
        filled, middles = len(table.rows), table.error
        assert table.fill(codes, folding, 0)
        assert len(table.rows) == filled, "nothing is filled twice"
        assert table.error == middles
    assert off[0] > 2 * off[1] > 3 * off[2]


def test_where_no_cell_is_narrow_enough_words_are_folded():
    head, codes = codec(), pixels()
    folding = Folding(head.fold())
    way = Tabulating(folding, 1e-6, cells=(1 / 2, 1 / 4))
    assert way(codes, WORDS).equal(folding(codes, WORDS))
    assert not way.cells
    assert not way.tables
    several = Tabulating(folding, 0.1)
    many = torch.randn(65, WIDTH)
    assert several(codes, many).equal(folding(codes, many))
    assert not several.tables


def test_codes_beyond_the_table_and_odd_ones_are_folded():
    head, folding = codec(), Folding(codec().fold())
    codes = pixels(reach=2.5)
    codes[0, 0, 1] = math.nan
    codes[0, 1] = torch.tensor([REACH, 0, 0])
    way = Tabulating(folding, 0.05)
    exact, beyond = folding(codes, WORDS), (codes.abs() >= REACH).any(dim=-1)
    beyond[0, 0] = False  # is not a number
    assert beyond.any()
    assert not beyond.all()
    for _ in range(2):
        found = way(codes, WORDS)
        assert found[:, 0, 0].isnan().all()
        torch.testing.assert_close(found[:, beyond], exact[:, beyond], rtol=0, atol=1e-6)
        off = (found - exact)[:, ~beyond][:, 1:].nan_to_num(0).abs().max()
        assert 1e-5 < off <= 1.3 * 0.05
    assert in_float64(head, codes[5:6], WORDS).isfinite().all()


def test_codes_that_need_more_nodes_than_they_are_worth_are_folded():
    folding = Folding(codec().fold())
    way = Tabulating(folding, 0.05)
    few = torch.rand(4, 5, 3) * 2 - 1
    assert way(few, WORDS).equal(folding(few, WORDS))
    (table,) = way.tables.values()
    assert len(table.rows) == 0


def test_only_a_few_tables_are_kept():
    way = Tabulating(Folding(codec().fold()), 0.05)
    codes = pixels()
    for row in range(5):
        way(codes, WORDS[row : row + 1])
    assert len(way.tables) == 4
    assert WORDS[:1].numpy().tobytes() not in way.tables


def test_the_way_follows_from_the_head():
    assert isinstance(comparing(codec(), 0.0), Folding)
    assert isinstance(comparing(codec(), 0.01), Tabulating)
    assert isinstance(comparing(codec(4), 0.01), Folding)
    assert isinstance(comparing(Identity(4), 0.01), Decoding)


def test_words_of_another_width_and_bounds_that_are_none_are_refused():
    for way in (Folding(codec().fold()), Tabulating(Folding(codec().fold()), 0.1)):
        with pytest.raises(ValueError, match=r"as wide as the decoded features \(16\), got 7"):
            way(pixels(), torch.randn(2, 7))
    with pytest.raises(ValueError, match="within must be"):
        Tabulating(Folding(codec().fold()), 0.0)
    with pytest.raises(ValueError, match="within must be"):
        faster(SeveralFields([splats(codec())]), -1.0)


def splats(head: Autoencoder | Classifier, levels: int = 1) -> SplatField:
    generator = torch.Generator().manual_seed(3)
    n = 30
    raw = {
        "means": torch.rand(n, 3, generator=generator) + torch.tensor([-0.5, -0.5, 2.0]),
        "quats": torch.randn(n, 4, generator=generator),
        "log_scales": torch.full((n, 3), -2.0),
        "sh0": torch.randn(n, 3, generator=generator),
        "shN": torch.zeros(n, 0, 3),
        "opacity_logits": torch.zeros(n),
        "indicator_logits": torch.zeros(n),
        "features": torch.randn(n, levels * head.dim, generator=generator),
    }
    return SplatField(SplatModel(raw, NoFusion(), Learned(), head, RasterConfig(), 0))


def seen(levels: int) -> FieldImages:
    return FieldImages(feature=torch.stack([pixels() * (1 + i / 8) for i in range(levels)]))


@pytest.mark.parametrize("within", [0.0, 0.02])
def test_fields_of_any_make_answer_faster(within: float):
    camera = Camera(torch.eye(4), torch.eye(3), 80, 60)
    plane = Plane(torch.randn(WIDTH), 0.5)
    one, two = splats(codec()), splats(codec(), levels=2)
    made: dict[str, tuple[Field, FieldImages, float]] = {
        "one level": (one, seen(1), within),
        "two levels": (two, seen(2), within),
        "the second of two": (two.levels()[1], seen(1), within),
        "levels apart": (SeveralFields([one, one]), seen(2), within),
        "planes": (with_planes(one, WORDS[:1], [plane]), seen(1), 0.0),
    }
    for name, (field, images, bound) in made.items():
        exact = field.similarity(camera, WORDS, images)
        quick = faster(field, within)
        assert type(quick) is type(field), name
        found = quick.similarity(camera, WORDS, images)
        off = float((found - exact).abs().max())
        assert off <= max(1.3 * bound, 1e-5), name
        assert (off > 1e-5) == (bound > 0), name
        for index, level in enumerate(quick.levels()):
            part = FieldImages(feature=images.feature[index : index + 1])  # pyright: ignore[reportOptionalSubscript]
            torch.testing.assert_close(level.similarity(camera, WORDS, part)[0], found[index])
        assert field.similarity(camera, WORDS, images).equal(exact), name


def test_objects_stay_probabilities():
    head = Classifier(2)
    head.fit(torch.eye(WIDTH)[:4], torch.ones(4))
    field = splats(head).with_objects(WORDS[:1], torch.tensor([[True, False, True, False]]))
    quick = faster(field)
    assert isinstance(quick, ObjectField)
    exact, found = (f.gaussian_similarity(WORDS) for f in (field, quick))
    assert found[0, 0].equal(exact[0, 0])
    torch.testing.assert_close(found, exact, rtol=0, atol=1e-5)
