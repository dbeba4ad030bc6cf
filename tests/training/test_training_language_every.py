"""Iterations that learn colour alone, between those that learn language too (``trainer.language_every``)."""

from itertools import pairwise
from pathlib import Path

import pytest
import torch
from test_training_fast import module_of, trained

from vlgs.training.lightning import VLGSModule
from vlgs.training.settings import LearningRates, TrainerConfig
from vlgs.types import Scene

SECOND = "trainer.language_every=2"


def rates(module: VLGSModule, step: int) -> dict[str, float]:
    module.set_schedule(step)
    return {group["name"]: group["lr"] for group in module.optimizer.param_groups}


def test_every_second_iteration_learns_colour_alone(tiny_scene: Scene):
    module = module_of(tiny_scene, SECOND)
    for step, has_language in enumerate((False, True, False, True)):
        done = module.step.forward(step)
        assert ("language 1" in done.terms) is has_language
        assert all((r.feature is not None) is has_language for r in done.seen.renders)
        assert all(r.color is not None for r in done.seen.renders)


def test_language_counts_as_much_on_the_mean_and_colour_as_ever(tiny_scene: Scene):
    often, seldom = (
        module_of(tiny_scene, f"trainer.language_every={n}", "trainer.iterations=30")
        for n in (1, 3)
    )
    assert set(seldom.step.forward(3).terms) == {"color"}
    alike, thrice = often.step.forward(5).terms, seldom.step.forward(5).terms
    assert alike.keys() == thrice.keys() > {"color"}
    for name, term in alike.items():
        torch.testing.assert_close(thrice[name], term if name == "color" else 3 * term)


def test_what_language_alone_moves_goes_as_far_in_fewer_iterations(tiny_scene: Scene):
    own = ("features", "indicator_logits", "language_log_scales", "language_quats")
    often, seldom = (
        rates(
            module_of(
                tiny_scene,
                "sharing=pos",
                "trainer.iterations=30",
                f"trainer.language_every={n}",
            ),
            7,
        )
        for n in (1, 3)
    )
    assert often.keys() == seldom.keys() > set(own)
    for name, rate in often.items():
        assert seldom[name] == pytest.approx(3 * rate if name in own else rate), name


def test_between_two_of_them_no_language_moves(tiny_scene: Scene, tmp_path: Path):
    codes: list[torch.Tensor] = []

    def keep(module: VLGSModule) -> None:
        codes.append(module.model.splats["features"].detach().clone())

    few = ("trainer.iterations=4", "gaussians.densify.stop=0", "fusion=none")
    trained(tiny_scene, tmp_path / "run", *few, SECOND, each=keep)
    moved = [not torch.equal(a, b) for a, b in pairwise(codes)]
    assert moved == [True, False, True]  # iterations 2, 3 and 4


def test_what_has_no_language_keeps_every_bit(tiny_scene: Scene, tmp_path: Path):
    def colour(name: str, *overrides: str) -> dict[str, torch.Tensor]:
        module = trained(tiny_scene, tmp_path / name, "trainer.iterations=6", *overrides)
        return {key: value.detach() for key, value in module.model.splats.items()}

    none = "~loss.language", "~loss.blended_view"
    often, seldom = colour("often", *none), colour("seldom", *none, SECOND)
    assert all(torch.equal(often[name], seldom[name]) for name in often)


@pytest.mark.parametrize(
    "overrides",
    [
        (
            "trainer.freeze=[means,quats,log_scales,sh0,shN,opacity_logits]",
            "gaussians.densify.stop=0",
            "fusion=none",
        ),
        ("~loss.photometric",),
    ],
    ids=["shapes are frozen", "no colour is learned"],
)
def test_where_there_is_language_alone_every_iteration_learns_it(
    tiny_scene: Scene, overrides: tuple[str, ...]
):
    module, plain = (module_of(tiny_scene, *overrides, *more) for more in ((SECOND,), ()))
    assert rates(module, 0) == rates(plain, 0)
    for step in (0, 1):
        terms = module.step.forward(step).terms
        assert "language 1" in terms
        assert all(torch.equal(terms[k], v) for k, v in plain.step.forward(step).terms.items())


def test_what_is_no_number_of_iterations_is_refused():
    with pytest.raises(ValueError, match="trainer: language_every must be"):
        TrainerConfig(10, LearningRates(), language_every=0)
