"""Attributes that start at random, and codes of few weights."""

from dataclasses import replace

import pytest
import torch

from vlgs.gaussians import GaussiansConfig, attributes_of
from vlgs.gaussians.attributes import STANDARD, sparse_softmax
from vlgs.gaussians.config import AttributeConfig
from vlgs.gaussians.parameters import conform


def test_four_of_64_weights_are_kept_and_add_up_to_one():
    logits = torch.randn(50, 64, requires_grad=True)
    codes = replace(STANDARD["features"], activation="sparse").activate(logits)
    assert codes.count_nonzero(dim=1).eq(4).all()
    torch.testing.assert_close(codes.sum(dim=1), torch.ones(50))
    for raw, row in zip(logits.detach(), codes.detach(), strict=True):
        best = raw.sort(descending=True).indices[:4]
        torch.testing.assert_close(row[best], raw[best].softmax(dim=0))
    codes.square().sum().backward()
    assert logits.grad is not None
    assert not logits.grad[codes == 0].any()  # what is not blended learns nothing


def test_equal_weights_keep_the_first():
    kept = sparse_softmax(torch.zeros(3, 8), 4)
    assert torch.equal(kept, torch.tensor([[0.25] * 4 + [0.0] * 4]).repeat(3, 1))


@pytest.mark.parametrize("activation", ["sparse", "unit"])
def test_codes_of_several_levels_are_activated_one_by_one(activation: str):
    row = replace(STANDARD["features"], activation=activation)  # pyright: ignore[reportArgumentType]
    raw = torch.randn(5, 30)
    both = replace(row, parts=3).activate(raw)
    assert torch.equal(both, torch.cat([row.activate(part) for part in raw.split(10, dim=1)], 1))


def test_a_drawn_start_follows_from_the_seed():
    config = GaussiansConfig(
        init_features="normal", attributes={"ids": AttributeConfig(4, start="normal")}
    )
    points = {"means": torch.zeros(3000, 3)}

    def start(seed: int):
        before = torch.get_rng_state()
        made = conform(points, attributes_of(config, 8, seed=seed))
        assert torch.equal(before, torch.get_rng_state())
        return made

    first, other = start(0), start(1)
    assert all(torch.equal(first[name], value) for name, value in start(0).items())
    for name in ("features", "ids"):
        assert not torch.equal(first[name], other[name])
        assert abs(float(first[name].mean())) < 0.05
        assert abs(float(first[name].std()) - 1) < 0.05
    assert not torch.equal(first["features"][:, :4], first["ids"])
    assert not conform(points, attributes_of(GaussiansConfig(), 8))["features"].any()


def test_a_start_that_is_no_number_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)  # types would speak first
    with pytest.raises(ValueError, match="start must be a number or normal, got 'uniform'"):
        GaussiansConfig(attributes={"ids": {"width": 4, "start": "uniform"}})
