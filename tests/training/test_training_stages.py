"""Lists of stages: what each option contributes, and stages that no option of today has."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from tiny_runs import TINY, composed

from vlgs.config import instantiate
from vlgs.fields import Field, FieldImages
from vlgs.fields.trained import SplatField
from vlgs.runs import RunFolder
from vlgs.training.augment import NoAugment, Offline, RenderViews
from vlgs.training.build import Parts
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.fit import FitOptions
from vlgs.training.levels import LEVEL_OPTIONS, JoinLevels
from vlgs.training.sharing import TrainLanguage, Unite, choose_sharing
from vlgs.training.stages import (
    Lift,
    Method,
    Progress,
    Stage,
    Train,
    TrainColor,
    list_stages,
    run_stages,
)
from vlgs.training.workshop import Workshop
from vlgs.types import Camera, Scene

FROZEN = ("means", "quats", "log_scales", "sh0", "shN", "opacity_logits", "indicator_logits")
ONE, TWO = choose_sharing(), choose_sharing(means=False, covariances=False)
LIFTED = choose_sharing(lifted=True)
OFFLINE = Offline(views=2)
COLOR, GEOMETRY = TrainColor("color"), TrainColor("geometry", kept=False)


def workshop_in(folder: Path, *overrides: str) -> Workshop:
    config = composed(*TINY, "trainer=smoke", "trainer.iterations=24", "fusion=none", *overrides)

    def make_parts() -> Parts:
        torch.manual_seed(0)
        return Parts(**{part.name: instantiate(config[part.name]) for part in fields(Parts)})

    options = FitOptions(meta={}, progress=False)
    return Workshop(RunFolder(folder), make_parts, lambda: options, 0)


def tensors(progress: Progress) -> dict[str, torch.Tensor]:
    field = progress.field()
    assert isinstance(field, SplatField)
    return dict(field.model.state_dict())


def test_each_option_contributes_its_part_of_the_list():
    single, separate, joint = LEVEL_OPTIONS.values()
    added = [TrainColor("augment", kept=False), RenderViews(OFFLINE)]
    apart = [COLOR, TrainLanguage("language"), Unite()]
    lists: dict[tuple[Any, ...], list[Stage]] = {
        (NoAugment(), single, ONE): [Train()],
        (NoAugment(), separate, TWO): apart,
        (NoAugment(), joint, LIFTED): [JoinLevels(), GEOMETRY, Lift("geometry")],
        (OFFLINE, single, ONE): [*added, Train()],
        (OFFLINE, joint, TWO): [*added, JoinLevels(), *apart],
    }
    for options, want in lists.items():
        assert list(list_stages(options)) == want
        assert all(isinstance(stage, Stage) for stage in want)
    for sharing, want in ((ONE, [Train()]), (TWO, [COLOR]), (LIFTED, [Train()])):
        assert list(list_stages([sharing], language=False)) == want


@pytest.mark.usefixtures("unchecked")
def test_features_alone_learn_on_the_geometry_of_an_earlier_stage(
    tiny_scene: Scene, tmp_path: Path
):
    method = Method((GEOMETRY, Train(start="geometry", freeze=FROZEN)))
    workshop = workshop_in(tmp_path / "whole", "indicator=opacity")
    progress = run_stages([method], {3: tiny_scene}, workshop)
    assert list(workshop.made) == ["geometry", ""]
    assert [made.folder.path for made in workshop.kept] == [tmp_path / "whole"]
    learned, geometry = tensors(progress), progress.gaussians("geometry", 3)
    assert all(torch.equal(learned[f"splats.{name}"], geometry.splats[name]) for name in FROZEN)
    assert learned["splats.features"].abs().max() > 0
    assert not geometry.splats["features"].any(), "later stages must not move earlier ones"

    killed = workshop_in(tmp_path / "parts", "indicator=opacity", "trainer.checkpoint_every=10")
    options = killed.make_options()
    checkpoint = RunFolder(tmp_path / "parts").checkpoint
    killed.make_options = lambda: replace(options, callbacks=[_Killed(checkpoint)])
    with pytest.raises(RuntimeError, match="killed"):
        run_stages([method], {3: tiny_scene}, killed)
    assert (tmp_path / "parts" / "geometry" / "checkpoint").is_dir()
    resumed = run_stages(
        [method], {3: tiny_scene}, workshop_in(tmp_path / "parts", "indicator=opacity")
    )
    again = tensors(resumed)
    assert again.keys() == learned.keys()
    assert all(torch.equal(again[name], learned[name]) for name in again)


class _Killed(lightning.Callback):
    """Dies as soon as a checkpoint is in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_train_batch_end(self, *args: Any, **kwargs: Any) -> None:
        if self.folder.is_dir() and (load_checkpoint(self.folder) or None):
            raise RuntimeError("killed")


class Grey:
    """A trained scene without a single Gaussian."""

    outputs = frozenset({"color"})
    has_language = True

    def levels(self) -> list[Field]:
        return [self]

    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        return FieldImages(color=torch.full((camera.height, camera.width, 3), 0.5))

    def similarity(
        self, camera: Camera, words: torch.Tensor, seen: Any = None, pixels: Any = None
    ) -> torch.Tensor:
        raise NotImplementedError


@dataclass(frozen=True)
class MakeGrey:
    """A stage that is no splat at all."""

    name: str = "grey"

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        return progress.having(self.name, {None: Grey()})


def test_a_stage_may_make_something_else_than_gaussians(tiny_scene: Scene, tmp_path: Path):
    workshop = workshop_in(tmp_path)
    scenes: dict[int | None, Scene] = {level: tiny_scene for level in (1, 2)}
    progress = run_stages([Method((MakeGrey(),))], scenes, workshop)
    assert [type(field) for field in progress.field().levels()] == [Grey, Grey]
    camera = tiny_scene.test[0].camera
    assert progress.field().render(camera, frozenset({"color"})).color is not None
    assert workshop.kept == []
    with pytest.raises(ValueError, match="stages: 'grey' must make Gaussians to start from"):
        run_stages([Method((MakeGrey(), Lift("grey")))], scenes, workshop)


def test_a_start_that_is_no_earlier_stage_is_named(tiny_scene: Scene, tmp_path: Path):
    with pytest.raises(ValueError, match=r"start must be an earlier stage \(none\), got 'shape'"):
        run_stages([Method((Train(start="shape"),))], {3: tiny_scene}, workshop_in(tmp_path))
