"""The step that is written out is the step that trains, or nothing is measured."""

import functools

import pytest

from vlgs.bench import seams
from vlgs.bench.iteration import IterationSize


@pytest.mark.slow
def test_seams_are_measured_on_the_same_bits_or_not_at_all(monkeypatch: pytest.MonkeyPatch):
    size = IterationSize(300, 48, 36, 4, 0)
    monkeypatch.setattr(seams, "SMALL", IterationSize(60, 24, 18, 4, 0))
    monkeypatch.setattr(seams, "make_module", functools.cache(seams.make_module))
    cost = seams.measure_seams(1, size)
    assert 0 < cost.step < 1000
    assert cost.share == cost.seams / cost.step
    monkeypatch.setattr(seams, "L1_SHARE", 0.7)
    with pytest.raises(RuntimeError, match="written out must be the step that trains"):
        seams.measure_seams(1, size)
