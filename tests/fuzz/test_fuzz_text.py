"""Hostile names and damaged results, a few of each kind: everything is met rightly."""

import pytest

from tests.fuzz.__main__ import run_family

FEW = {"text": 0, "results": 0}
EVERY = {"text": 7, "results": 13}
"""Attacks of the fixed lists that are tried here; `python -m tests.fuzz` tries all."""


@pytest.mark.parametrize("family", sorted(FEW))
def test_a_sample_of_the_attacks_is_met_rightly(family: str, monkeypatch: pytest.MonkeyPatch):
    from tests.fuzz import results, text

    module = {"results": results, "text": text}[family]
    attacks = module.attacks
    monkeypatch.setattr(module, "attacks", lambda *given: list(attacks(*given))[:: EVERY[family]])
    outcomes = run_family(family, seed=0, count=FEW[family])
    assert len(outcomes) > 50
    assert not [f"{o.name}: {o.said}" for o in outcomes if not o.right]
