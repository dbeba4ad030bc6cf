"""FMGS: its losses by hand, what it draws against its definition, and what learns and what does not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_training_radiance import GRID, SETTINGS, Killed
from tiny_runs import TINY, composed

from vlgs.experiment import construct
from vlgs.fields import Field, HasGaussians
from vlgs.fields.hash_splat import HashSplatField
from vlgs.fields.language_field import LanguageConfig
from vlgs.fields.radiance import in_cube
from vlgs.geometry import resize_camera
from vlgs.ops.rasterize import rasterize
from vlgs.run import run
from vlgs.runs import RunFolder
from vlgs.training.fit import FitOptions
from vlgs.training.hash_features import (
    HashLearner,
    TrainHashFeatures,
    alignment_loss,
    embedding_loss,
    neighbour_cosines,
    second_loss,
)
from vlgs.training.joint import join_levels
from vlgs.training.learner import Descent, generator_of
from vlgs.training.second_map import FolderMap, PhotographMap
from vlgs.training.stages import Method, Progress, TrainColor, run_stages
from vlgs.training.workshop import Workshop
from vlgs.types import ChannelGroup, Scene

STAGE = TrainHashFeatures(
    "geometry", network=LanguageConfig([GRID], hidden=1, width=16, scaled=False, half=False)
)
METHOD = Method([TrainColor("geometry", kept=False), STAGE])


def workshop_in(folder: Path, *callbacks: Killed) -> Workshop:
    experiment = construct(composed("method=fmgs", *TINY))
    options = FitOptions(meta={}, progress=False, callbacks=callbacks)

    def make_parts():
        return replace(experiment.make_parts(), trainer=SETTINGS)

    return Workshop(RunFolder(folder), make_parts, lambda: options, 0)


@pytest.fixture(scope="module")
def made(tiny_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> tuple[Progress, Workshop]:
    workshop = workshop_in(tmp_path_factory.mktemp("fmgs"))
    return run_stages([METHOD], {3: tiny_scene}, workshop), workshop


def field_of(progress: Progress) -> HashSplatField:
    field = progress.field()
    assert isinstance(field, HashSplatField)
    return field


def test_it_is_a_field_of_gaussians_that_stay_as_they_are(made: tuple[Progress, Workshop]):
    progress, workshop = made
    field = field_of(progress)
    assert isinstance(field, Field)
    assert isinstance(field, HasGaussians)
    assert [m.gaussians for m in workshop.kept] == [field.splats.model.count]
    geometry = progress.gaussians("geometry", 3)
    assert field.splats.model is geometry
    assert not geometry.splats["features"].any()


def test_what_is_asked_is_the_network_at_the_means(
    made: tuple[Progress, Workshop], tiny_scene: Scene
):
    field, camera = field_of(made[0]), tiny_scene.test[0].camera
    gaussians, words = field.splats.model.gaussians(), tiny_scene.mask_vectors[:3]
    places = in_cube((gaussians.means - field.frame.center) * field.frame.scale)
    said = field.language.embed(field.language.features(places))
    torch.testing.assert_close(said.norm(dim=1), torch.ones(len(said)), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(
        field.gaussian_similarity(words)[0], words @ said.T, rtol=1e-4, atol=1e-5
    )
    group = ChannelGroup(said, gaussians.opacities)
    shape = gaussians.means, gaussians.quats, gaussians.scales
    view = camera.viewmat, camera.K, 48, 36
    drawn = rasterize(*shape, [group], *view, field.splats.model.raster).images[0]
    feature = field.render(camera, frozenset({"feature"})).feature
    assert feature is not None
    torch.testing.assert_close(feature[0], drawn, rtol=1e-4, atol=1e-5)


def test_stopped_in_its_second_stage_it_goes_on_to_the_same_bits(
    made: tuple[Progress, Workshop], tiny_scene: Scene, tmp_path: Path
):
    killed = workshop_in(tmp_path, Killed(2, 7))
    with pytest.raises(RuntimeError, match="killed"):
        run_stages([METHOD], {3: tiny_scene}, killed)
    resumed = field_of(run_stages([METHOD], {3: tiny_scene}, workshop_in(tmp_path)))
    whole = field_of(made[0])
    torch.testing.assert_close(resumed.language.state_dict(), whole.language.state_dict(), rtol=0, atol=0)  # fmt: skip
    words = tiny_scene.mask_vectors[:3]
    assert torch.equal(resumed.gaussian_similarity(words), whole.gaussian_similarity(words))


def test_a_step_draws_half_of_a_view_and_moves_the_networks_alone(
    made: tuple[Progress, Workshop], tiny_scene: Scene
):
    splats = made[0].gaussians("geometry", 3)
    for parameter in splats.parameters():
        parameter.requires_grad_(True)
        parameter.grad = None
    learner = HashLearner(tiny_scene, splats, STAGE, SETTINGS, 0)
    early, late = (learner.terms(draw, generator_of(0)) for draw in (0, 8))
    assert set(early) == {"language", "second"}
    assert set(late) == {"language", "second", "alignment"}
    torch.stack([*late.values()]).sum().backward()
    assert all(p.grad is None for p in splats.parameters())
    assert all(p.grad is not None and p.grad.any() for p in learner.model.parameters())

    index = next(iter(learner._rows))
    view, camera = learner._view(index), tiny_scene.train[index].camera
    gaussians = splats.gaussians()
    said = learner.model.embed(learner.model.features(learner.places))
    shape = gaussians.means, gaussians.quats, gaussians.scales
    half = resize_camera(camera, 24, 18)
    group = ChannelGroup(said, gaussians.opacities)
    small = half.viewmat, half.K, 24, 18
    want = rasterize(*shape, [group], *small, splats.raster).images[0]
    torch.testing.assert_close(view.weights.render(said[view.rows]), want, rtol=1e-4, atol=1e-5)
    cooled = learner.terms(0, generator_of(0))["language"]
    assert cooled > 0


def test_the_target_is_the_mean_over_mask_levels(
    made: tuple[Progress, Workshop], tiny_scene: Scene
):
    other = replace(tiny_scene, mask_vectors=tiny_scene.mask_vectors.flip(0))
    learner = HashLearner(join_levels([tiny_scene, other]), made[0].gaussians("geometry", 3), replace(STAGE, shrink=1), SETTINGS, 0)  # fmt: skip
    vectors, valid = learner._vectors(0, torch.Size((36, 48)))
    read = tiny_scene.train[0].read_masks
    assert read is not None
    rows = read().long()
    assert torch.equal(valid, rows >= 0)
    mean = (tiny_scene.mask_vectors[rows] + other.mask_vectors[rows]) / 2
    torch.testing.assert_close(vectors[valid], mean[valid])


def test_losses_are_those_by_hand():
    image = torch.tensor([[[0.5, 2.0], [9.0, 9.0]]])
    valid = torch.tensor([[True, False]])
    want = 0.5 * 0.25 + 1.25 * (2.0 - 0.5 * 1.25)
    torch.testing.assert_close(
        embedding_loss(image, torch.zeros_like(image), valid), torch.tensor(want)
    )
    assert embedding_loss(image, image + 1, valid & False) == 0
    torch.testing.assert_close(second_loss(image, image - 2.0), torch.tensor(8.0))


def test_alignment_is_that_of_a_loop_over_neighbours():
    torch.manual_seed(0)
    embedding, low = (
        torch.randn(5, 4, 3, requires_grad=True),
        torch.randn(5, 4, 2, requires_grad=True),
    )

    def cosine(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return a @ b / (a.norm() * b.norm())

    total = []
    for y in range(1, 4):
        for x in range(1, 3):
            for dy in (-1, 0, 1):
                for dx in (-1, 0, 1):
                    if (dy, dx) != (0, 0):
                        at, beside = (y, x), (y + dy, x + dx)
                        total.append((cosine(embedding[at], embedding[beside]) - cosine(low[at], low[beside])).abs())  # fmt: skip
    loss = alignment_loss(embedding, low)
    torch.testing.assert_close(loss, torch.stack(total).mean())
    assert neighbour_cosines(low).shape == (8, 3, 2)
    loss.backward()
    assert embedding.grad is not None
    assert low.grad is None, "the second map leads, and does not follow"


def test_widths_and_counts_are_the_released_ones():
    method = construct(composed("method=fmgs")).method
    assert method is not None
    stage = method.listed[1]
    assert isinstance(stage, TrainHashFeatures)
    network = stage.network
    assert [(g.levels, g.features, g.coarsest, g.finest) for g in network.grids] == [
        (12, 8, 16, 128),
        (12, 8, 128, 512),
    ]
    assert (network.hidden, network.width, network.scaled) == (4, 256, False)
    assert stage.descent == Descent("radam", 5e-3, 2e-3, 10000, decay=1e-9, clip=1.0)
    assert (stage.balance, stage.alignment, stage.shrink) == (0.2, 0.01, 2)


def test_a_map_of_the_photograph_knows_colours_and_edges(tiny_scene: Scene):
    view = tiny_scene.train[0]
    grey = replace(view, read_image=lambda: torch.full((36, 48, 3), 119, dtype=torch.uint8))
    flat = PhotographMap().read(grey)
    assert flat.shape == (36, 48, PhotographMap().require(tiny_scene))
    torch.testing.assert_close(flat[..., 0], torch.full((36, 48), 0.5), rtol=0, atol=0.01)
    torch.testing.assert_close(flat[..., [1, 2, 6]], torch.zeros(36, 48, 3), rtol=0, atol=1e-3)
    assert PhotographMap().read(view)[..., 6].max() > 0.01


def test_maps_of_files_are_read_and_what_is_missing_is_named(tiny_scene: Scene, tmp_path: Path):
    for view in tiny_scene.train:
        np.save(tmp_path / f"{view.name}.npy", np.full((9, 12, 5), 0.25, np.float32))
    maps = FolderMap(str(tmp_path))
    assert maps.require(tiny_scene) == 5
    assert torch.equal(maps.read(tiny_scene.train[1]), torch.full((36, 48, 5), 0.25))
    first = tmp_path / f"{tiny_scene.train[0].name}.npy"
    np.save(first, np.zeros((9, 12, 4), np.float32))
    with pytest.raises(ValueError, match=r"second map: maps must have one width, got \[4, 5\]"):
        maps.require(tiny_scene)
    np.save(first, np.zeros((9, 12), np.float32))
    with pytest.raises(ValueError, match=r"must be an array \[h, w, c\], got \[9, 12\]"):
        maps.require(tiny_scene)
    first.unlink()
    with pytest.raises(ValueError, match="must be there, as every training view needs a map"):
        maps.require(tiny_scene)


def test_a_scene_without_second_maps_is_refused_before_training(tmp_path: Path):
    config = composed("method=fmgs", *TINY, "stages.1.second.folder=nowhere", f"results={tmp_path}")
    with pytest.raises(ValueError, match=r"second map: nowhere/frame_\d+.npy must be there"):
        run(config)
    assert not (tmp_path / "runs").exists()
