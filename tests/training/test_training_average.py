"""The mean of the last iterations: of which, over which, and across an interruption."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from tiny_runs import TINY, composed
from torch import Tensor

from vlgs.config import instantiate
from vlgs.runs import RunFolder
from vlgs.training.average import EVERY
from vlgs.training.build import Parts, build_module
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.types import Scene

STEPS = 24
FIRST = 12  # the iteration after which no Gaussian comes or goes
GIVEN = (
    f"trainer.iterations={STEPS}",
    "trainer.checkpoint_every=4",
    f"gaussians.densify={{start: 2, stop: {FIRST}, every: 4, reset_every: 0}}",
    "gaussians.densify.grad_threshold=1e-6",
    "gaussians.silent_above=1.0",
    "gaussians.clear_air=false",
)


def parts_of(*overrides: str) -> Parts:
    config = composed(*TINY, "trainer=smoke", *GIVEN, *overrides)
    return Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})


def fitted(
    scene: Scene, folder: Path, *overrides: str, until: int = STEPS
) -> tuple[VLGSModule, list[Mapping[str, Tensor]]]:
    """A trained module, and what it held after each iteration; a run that stops early is stopped as by Ctrl-C."""
    torch.manual_seed(0)
    module = build_module(scene, parts_of(*overrides), 0)
    original, seen = module.training_step, []

    def step(number: int, batch_idx: int) -> None:
        original(number, batch_idx)
        seen.append({name: p.detach().clone() for name, p in module.step.trained()})
        if number + 1 == until:
            module.trainer.should_stop = True

    module.training_step = step  # type: ignore[method-assign]
    fit(module, RunFolder(folder), FitOptions(meta={}, progress=False))
    return module, seen


def mean_of(seen: list[Mapping[str, Tensor]], name: str, since: int) -> Tensor:
    """Over every `EVERY`-th iteration up to the last, counted from 1, that comes after `since`."""
    kept = [seen[i - 1][name] for i in range(STEPS, since, -EVERY)]
    return torch.stack(kept).double().mean(0).float()


@pytest.mark.parametrize(
    ("share", "since"),
    [(0.25, 18), (0.9, FIRST), pytest.param(1.0, FIRST, marks=pytest.mark.slow)],
)
def test_language_is_the_mean_of_the_last_iterations_and_colour_the_last(
    tiny_scene: Scene, tmp_path: Path, share: float, since: int
):
    module, seen = fitted(tiny_scene, tmp_path, f"trainer.average_language={share}")
    for name in ("splats.features", "splats.indicator_logits"):
        value = dict(module.step.trained())[name]
        torch.testing.assert_close(value, mean_of(seen, name, since), rtol=1e-6, atol=1e-7)
        assert not torch.equal(value, seen[-1][name])
    for name, value in module.step.trained():
        if name not in ("splats.features", "splats.indicator_logits"):
            assert torch.equal(value, seen[-1][name]), name


@pytest.mark.usefixtures("unchecked")
def test_colour_is_all_else(tiny_scene: Scene, tmp_path: Path):
    module, seen = fitted(tiny_scene, tmp_path, "trainer.average_color=0.5")
    for name, value in module.step.trained():
        if name in ("splats.features", "splats.indicator_logits"):
            assert torch.equal(value, seen[-1][name]), name
        else:
            torch.testing.assert_close(value, mean_of(seen, name, 12), rtol=1e-6, atol=1e-7)


@pytest.mark.usefixtures("unchecked")
def test_a_resumed_mean_is_that_of_a_run_in_one_go(tiny_scene: Scene, tmp_path: Path):
    averages = ("trainer.average_language=0.5", "trainer.average_color=0.25")
    whole, _ = fitted(tiny_scene, tmp_path / "whole", *averages)
    _, seen = fitted(tiny_scene, tmp_path / "parts", *averages, until=19)
    assert len(seen) == 19
    resumed, rest = fitted(tiny_scene, tmp_path / "parts", *averages)
    assert len(rest) == STEPS - 19
    for (name, one), (_, other) in zip(whole.step.trained(), resumed.step.trained(), strict=True):
        assert torch.equal(one, other), name


@pytest.mark.usefixtures("unchecked")
def test_nothing_is_averaged_by_default(tiny_scene: Scene, tmp_path: Path):
    module, seen = fitted(tiny_scene, tmp_path)
    assert all(torch.equal(value, seen[-1][name]) for name, value in module.step.trained())
    assert module.means.sums == {}


def test_a_mean_over_gaussians_that_come_and_go_is_refused():
    with pytest.raises(
        ValueError,
        match=r"^trainer: average_language and average_color must have iterations after gaussians\.densify\.stop, got 24 of 24; 0 turns them off$",
    ):
        parts_of("trainer.average_language=0.2", f"gaussians.densify.stop={STEPS}")


@pytest.mark.parametrize("name", ["average_language", "average_color"])
def test_a_share_beyond_all_is_refused(name: str):
    with pytest.raises(ValueError, match=f"trainer: {name} must be"):
        parts_of(f"trainer.{name}=1.1")
