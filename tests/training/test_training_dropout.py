"""Gaussians that an iteration leaves out (``trainer.dropout``)."""

from pathlib import Path

import numpy as np
import pytest
import torch
from test_training_fast import module_of, trained

from vlgs.training.dropout import leave_out
from vlgs.training.lightning import VLGSModule
from vlgs.training.settings import LearningRates, TrainerConfig
from vlgs.types import Scene

SOME = ("trainer.iterations=6", "trainer.dropout=0.5", "trainer.dropout_views=100")


def state(module: VLGSModule) -> dict[str, torch.Tensor]:
    return {name: parameter.detach() for name, parameter in module.model.splats.items()}


def test_what_is_left_weighs_as_much_as_all_over_many_draws(tiny_scene: Scene):
    fused = module_of(tiny_scene).model.fuse()
    fused.gaussians.opacities.data.clamp_(max=0.6)
    draws = [leave_out(fused, 0.3, np.random.default_rng(seed)) for seed in range(2000)]
    for of in (lambda f: f.gaussians.opacities, lambda f: f.language_weight):
        weights = torch.stack([of(draw) for draw in draws]).detach()
        zero = weights == 0
        assert abs(zero.float().mean().item() - 0.3) < 0.01
        torch.testing.assert_close(weights[0][~zero[0]], (of(fused) / 0.7)[~zero[0]])
        torch.testing.assert_close(weights.mean(dim=0), of(fused).detach(), rtol=0.08, atol=0)
    first = draws[0]
    assert torch.equal(first.gaussians.opacities == 0, first.language_weight == 0)


def test_no_weight_is_above_one(tiny_scene: Scene):
    fused = module_of(tiny_scene).model.fuse()
    fused.gaussians.opacities.data.fill_(0.95)
    left = leave_out(fused, 0.5, np.random.default_rng(0)).gaussians.opacities
    assert set(left.tolist()) == {0.0, 1.0}


def test_groups_of_one_weight_share_their_transmittance(tiny_scene: Scene):
    fused = module_of(tiny_scene, "indicator=opacity").model.fuse()
    assert fused.language_weight is fused.gaussians.opacities
    left = leave_out(fused, 0.5, np.random.default_rng(0))
    assert left.language_weight is left.gaussians.opacities


@pytest.mark.parametrize(("views", "share"), [(3, 0.18), (12, 0.12), (30, 0.0), (300, 0.0)])
def test_many_views_leave_nothing_out_and_late_iterations_most(views: int, share: float):
    settings = TrainerConfig(10, LearningRates(), dropout=0.2)
    assert settings.dropout_at(10, views) == pytest.approx(share)
    assert settings.dropout_at(5, views) == pytest.approx(share / 2)
    assert settings.dropout_at(0, views) == 0


def test_an_iteration_leaves_out_the_same_in_all_its_views_and_others_in_the_next(
    tiny_scene: Scene,
):
    module = module_of(tiny_scene, *SOME)
    out = [module.step.forward(step).seen.fused.gaussians.opacities == 0 for step in (4, 4, 5)]
    assert 0 < out[0].float().mean() < 1
    assert torch.equal(out[0], out[1])
    assert not torch.equal(out[0], out[2])


def test_it_moves_what_is_learned_of_few_views_alone(tiny_scene: Scene, tmp_path: Path):
    views = len(tiny_scene.train)
    runs = {
        name: state(trained(tiny_scene, tmp_path / name, *overrides))
        for name, overrides in {
            "none": SOME[:1],
            "some": SOME,
            "many views": (*SOME[:2], f"trainer.dropout_views={views}"),
        }.items()
    }
    for name, tensor in runs["none"].items():
        assert torch.equal(tensor, runs["many views"][name])
    assert not torch.equal(runs["none"]["sh0"], runs["some"]["sh0"])


def test_where_no_shape_is_learned_nothing_is_left_out(tiny_scene: Scene):
    frozen = "trainer.freeze=[means,quats,log_scales,sh0,shN,opacity_logits]"
    module = module_of(tiny_scene, *SOME, frozen, "gaussians.densify.stop=0", "fusion=none")
    assert (module.step.forward(5).seen.fused.gaussians.opacities > 0).all()


@pytest.mark.parametrize("wrong", ["dropout=1.0", "dropout=-0.1", "dropout_views=0"])
def test_what_is_no_share_is_refused(tiny_scene: Scene, wrong: str):
    with pytest.raises(ValueError, match=wrong.partition("=")[0]):
        module_of(tiny_scene, f"trainer.{wrong}")
