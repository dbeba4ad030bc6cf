"""Stages without Gaussians: what they learn from, and that they go on to the same bits."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from slow import with_slow
from tiny_runs import composed

from vlgs.experiment import construct
from vlgs.fields.hash_grid import GridConfig
from vlgs.fields.language_field import LanguageConfig
from vlgs.fields.nerf import NerfField
from vlgs.fields.radiance import RadianceConfig
from vlgs.geometry import camera_center
from vlgs.runs import RunFolder
from vlgs.training.fit import FitOptions
from vlgs.training.joint import join_levels
from vlgs.training.language_field import (
    LanguageLearner,
    TrainLanguageField,
    huber,
    mask_sides,
    rows_of,
)
from vlgs.training.learner import Descent, generator_of
from vlgs.training.radiance import RadianceLearner, TrainRadiance, frame_of
from vlgs.training.ray_bank import RayBank, pixels_of
from vlgs.training.settings import LearningRates, TrainerConfig
from vlgs.training.stages import Method, Progress, run_stages
from vlgs.training.workshop import Workshop
from vlgs.types import Scene

GRID = GridConfig(3, 2, 4, 16, 8)
RADIANCE = TrainRadiance(
    radiance=RadianceConfig(GRID, width=16, coarse=16, samples=8, cells=16), rays=64, batches=2
)
LANGUAGE = TrainLanguageField(
    "radiance", network=LanguageConfig([GRID], hidden=1, width=16), rays=64, scales=2
)
METHOD = Method([RADIANCE, LANGUAGE])
SETTINGS = TrainerConfig(12, LearningRates(), log_every=4, checkpoint_every=5)


def workshop_in(folder: Path, *callbacks: lightning.Callback) -> Workshop:
    parts = construct(composed("method=lerf")).parts
    options = FitOptions(meta={}, progress=False, callbacks=callbacks)
    make_parts = lambda: replace(parts, trainer=SETTINGS)  # noqa: E731
    return Workshop(RunFolder(folder), make_parts, lambda: options, 0)


class Killed(lightning.Callback):
    """Dies in one of the trainings after an iteration."""

    def __init__(self, model: int, step: int) -> None:
        self.left, self.step = model, step

    def on_train_start(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        self.left -= 1

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self.left == 0 and pl_module.next_step == self.step:
            raise RuntimeError("killed")


def made(progress: Progress) -> dict[str, torch.Tensor]:
    field = progress.field()
    assert isinstance(field, NerfField)
    assert field.language is not None
    return {
        **{f"radiance.{k}": v for k, v in field.radiance.state_dict().items()},
        **{f"language.{k}": v for k, v in field.language.state_dict().items()},
    }


@pytest.mark.parametrize("model", with_slow([1, 2], [1]))
@pytest.mark.usefixtures("unchecked")
def test_stopped_in_either_stage_it_goes_on_to_the_same_bits(
    tiny_scene: Scene, tmp_path: Path, model: int
):
    whole_workshop = workshop_in(tmp_path / "whole")
    whole = run_stages([METHOD], {3: tiny_scene}, whole_workshop)
    assert [m.gaussians for m in whole_workshop.kept] == [0, 0]
    assert (tmp_path / "whole" / "radiance" / "log.csv").read_text().count("\n") == 4
    stopping = workshop_in(tmp_path / "parts", Killed(model, 7))
    with pytest.raises(RuntimeError, match="killed"):
        run_stages([METHOD], {3: tiny_scene}, stopping)
    resumed = run_stages([METHOD], {3: tiny_scene}, workshop_in(tmp_path / "parts"))
    torch.testing.assert_close(made(resumed), made(whole), rtol=0, atol=0)
    again = run_stages([METHOD], {3: tiny_scene}, workshop_in(tmp_path / "parts"))
    torch.testing.assert_close(made(again), made(whole), rtol=0, atol=0)
    camera = tiny_scene.test[0].camera
    words = tiny_scene.mask_vectors[:3]
    scores = [p.field().similarity(camera, words) for p in (whole, again)]
    assert torch.equal(*scores)
    assert torch.isfinite(scores[0]).all()


def test_a_loss_that_is_not_finite_ends_it_and_says_where(tiny_scene: Scene, tmp_path: Path):
    learner = RadianceLearner(tiny_scene, RADIANCE, SETTINGS, 0)
    with torch.no_grad():
        next(learner.model.color_net.parameters())[0] = torch.nan
    with pytest.raises(FloatingPointError, match="photometric must be finite, got nan in step 3"):
        learner.training_step(3, 0)


def test_rays_are_those_of_the_photographs(tiny_scene: Scene):
    bank = RayBank(tiny_scene.train, tiny_scene.points)
    pixels = torch.tensor([0, 47, 48 * 36, 48 * 36 * 6 - 1])
    drawn = bank.at(pixels)
    assert drawn.views.tolist() == [0, 0, 1, 5]
    colors = pixels_of(tiny_scene.train)[pixels]
    assert torch.equal(colors[1], tiny_scene.train[0].read_image()[0, 47])
    assert torch.equal(colors[3], tiny_scene.train[5].read_image()[35, 47])
    camera = tiny_scene.train[5].camera
    torch.testing.assert_close(drawn.rays.origins[3], camera_center(camera.viewmat).float())
    ahead = drawn.rays.directions[3] @ camera.viewmat[:3, :3].T.float()
    at = camera.K.float() @ (ahead / ahead[2])
    torch.testing.assert_close(at[:2], torch.tensor([47.5, 35.5]))


def test_pixels_that_no_photograph_covers_are_not_drawn(tiny_scene: Scene):
    covered = torch.zeros(36, 48, dtype=torch.bool)
    covered[3, 4] = True
    first, *others = tiny_scene.train
    views = [replace(first, read_valid=lambda: covered), *others]
    bank = RayBank(views, tiny_scene.points)
    assert bank.count == 1 + 5 * 36 * 48
    drawn = bank.draw(4000, generator_of(0))
    assert set(drawn.pixels[drawn.views == 0].tolist()) <= {3 * 48 + 4}


def test_the_cameras_lie_around_the_unit_ball(tiny_scene: Scene):
    frame = frame_of(tiny_scene)
    centers = camera_center(torch.stack([view.camera.viewmat for view in tiny_scene.train]))
    distances = (centers - frame.center).norm(dim=1) * frame.scale
    assert 0.5 < distances.min() <= 1 <= distances.max() + 1e-5
    alone = replace(
        tiny_scene,
        train=tiny_scene.train[:1],
        points=tiny_scene.points[:0],
        point_colors=tiny_scene.point_colors[:0],
    )
    assert frame_of(alone).scale > 0


def test_the_loss_is_lerfs_by_hand():
    """Small differences cost half of their square, differences above 1.25 their size times 1.25; summed over numbers."""
    got = huber(torch.tensor([[0.5, 2.0], [0.0, 0.0]]), torch.tensor([[0.0, 0.0], [0.0, 1.0]]))
    want = (0.5 * 0.25 + 1.25 * (2.0 - 0.5 * 1.25) + 0.5) / 2
    torch.testing.assert_close(got, torch.tensor(want))


def test_language_learns_masks_at_the_scale_of_their_size(tiny_scene: Scene):
    scene = join_levels([tiny_scene, tiny_scene])
    learner = LanguageLearner(scene, RadianceLearner(tiny_scene, RADIANCE, SETTINGS, 0).model, LANGUAGE, SETTINGS, 0)  # fmt: skip
    read = tiny_scene.train[0].read_masks
    assert read is not None
    masks, rows = read(), rows_of(scene)
    assert torch.equal(rows[: 48 * 36, 0].view(36, 48), masks)
    assert set(rows[:, 1].tolist()) <= {
        -1,
        *range(len(tiny_scene.mask_vectors), len(scene.mask_vectors)),
    }
    row = int(masks.flatten().mode().values)
    everywhere = sum(int((view.read_masks() == row).sum()) for view in tiny_scene.train if view.read_masks)  # fmt: skip
    sides = mask_sides(rows, len(scene.mask_vectors))
    torch.testing.assert_close(sides[row].square(), torch.tensor(float(everywhere)))
    low, high = learner.scale_range()
    assert 0 < low < high
    terms = learner.terms(0, generator_of(0, 0))
    terms["language"].backward()
    assert learner.model.head[0].weight.grad is not None
    assert all(p.grad is None for p in learner.radiance[0].parameters())


def test_rates_fall_to_the_last_step_and_no_farther():
    descent = Descent("radam", rate=1e-2, final=1e-3, over=4000)
    assert [descent.at(s, 30000) for s in (0, 2000, 4000, 9000)] == pytest.approx(
        [1e-2, 1e-2 * 10**-0.5, 1e-3, 1e-3]
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["fusion=self"], "fusion must be none with a radiance field, as there are no Gaussians .*, got self"),
        (["indicator=learned"], "indicator must be fixed or opacity with a radiance field, as"),
        (["sharing=none", "fusion=none"], "sharing must be pos or pos_cov with stages of a method"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("method", with_slow(["lerf", "opennerf"], ["opennerf"]))
@pytest.mark.usefixtures("unchecked")
def test_axes_that_it_cannot_have_are_refused(method: str, overrides: list[str], message: str):
    with pytest.raises(ValueError, match=message):
        construct(composed(f"method={method}", *overrides))


def test_lerf_and_opennerf_are_what_their_programs_say():
    lerf, opennerf = (construct(composed(f"method={name}")).method for name in ("lerf", "opennerf"))
    assert lerf is not None
    assert opennerf is not None
    for method, hidden, scaled in ((lerf, 4, True), (opennerf, 1, False)):
        stage = method.listed[1]
        assert isinstance(stage, TrainLanguageField)
        network = stage.network
        assert (network.hidden, network.width, network.scaled) == (hidden, 256, scaled)
        assert sum(grid.width for grid in network.grids) == 192
        assert stage.descent == Descent("radam", 1e-2, 1e-3, 4000, decay=1e-9)
        assert stage.weight == 0.1
