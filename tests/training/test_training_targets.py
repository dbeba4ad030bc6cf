"""What training keeps of the views that it learns from."""

from collections import Counter
from dataclasses import replace

import pytest
import torch
from test_training_training import module_of
from torch import Tensor

from vlgs.types import Scene


@pytest.mark.parametrize("fits", [True, False])
def test_targets_of_all_views_are_kept_or_those_of_an_iteration(
    tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch, fits: bool
):
    size = 48 * 36 * (3 * 4 + 3 * 4 + 1)
    monkeypatch.setattr("vlgs.objectives.targets.TARGET_BYTES", (6 if fits else 5) * size)
    reads: Counter[str] = Counter()

    def counted(name: str, read):
        def again() -> Tensor:
            reads[name] += 1
            return read()

        return again

    views = [replace(v, read_image=counted(v.name, v.read_image)) for v in tiny_scene.train]
    module = module_of(replace(tiny_scene, train=tuple(views)))
    assert module.views.cache.limit == (6 if fits else 2) * size
    steps = 12  # two epochs
    for step in range(steps):
        module.training_step(step, 0)
    # The similarity of a pair asks for both images again, in the same iteration.
    assert reads.total() == 6 if fits else steps < reads.total() <= 2 * steps
    assert torch.isfinite(torch.tensor(module.report.loss))
