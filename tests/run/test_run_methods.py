"""What every option of conf/method does, whichever system it is: train, stop, go on, be read back, and answer as a field."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig
from slow import with_slow
from tiny_runs import TINY, composed

import vlgs.fields.language_field
import vlgs.fields.radiance
import vlgs.finish
import vlgs.training.checkpoint
from vlgs.config import CONF
from vlgs.fields import Field, HasGaussians
from vlgs.fields.hash_grid import GridConfig, HashGrid
from vlgs.files import write_atomically
from vlgs.known import options
from vlgs.manual import list_options
from vlgs.opened import open_run
from vlgs.run import run
from vlgs.runs import RunFolder
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.stages import Progress
from vlgs.types import Scene

SHORT = (
    *TINY,
    "trainer=smoke",
    "trainer.iterations=13",
    "trainer.checkpoint_every=5",
    "gaussians.densify={start: 2, stop: 12, every: 4}",
    "pictures=false",
)
METHODS = options("method")
RAYS = (
    *("+stages.0.rays=256", "+stages.0.batches=1", "+stages.1.rays=256"),
    "+stages.0.radiance={_target_: vlgs.fields.radiance.RadianceConfig, coarse: 32, samples: 8}",
    *("data.width=24", "data.height=18"),
)
QUICK = {"best"}
"""Colour, and then a linear system. Both at once is stopped and gone on with among the tests of training."""
SHORTER = {
    "lerf": (
        *RAYS,
        "stages.1.scales=2",
        "+stages.1.network={_target_: vlgs.fields.language_field.LanguageConfig, width: 32}",
    ),
    "opennerf": (*RAYS, "+stages.1.network.width=32"),
    "fmgs": (
        "+stages.1.network={_target_: vlgs.fields.language_field.LanguageConfig, width: 32, scaled: false, half: true}",
    ),
    "legaussians": ("head.quantiser.steps=50",),
}
"""Method -> what makes it quick, where an iteration, a view or the fit of the head takes long."""


def short(*overrides: str) -> DictConfig:
    """The configuration of a run of 13 iterations; the settings of an autoencoder are for methods that have one."""
    head = composed(*overrides).head
    fitting = [
        o for o in SHORT if not o.startswith("head.") or o.split(".")[1].split("=")[0] in head
    ]
    return composed(*fitting, *overrides)


@dataclass
class Ran:
    """A run, and what it did."""

    folder: RunFolder
    metrics: dict[str, Any]
    field: Field
    scene: Scene
    written: list[Path]
    """Checkpoints, in their order."""


class KilledError(Exception):
    """The process is gone."""


class Runner:
    """Runs a method in a folder of its own, and stops it hard after so many checkpoints."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.fields: list[tuple[Field, Scene]] = []
        self.written: list[Path] = []
        self.last: int | None = None
        report = vlgs.finish.report

        def reporting(ready: Any, progress: Progress, *rest: Any) -> dict[str, Any]:
            self.fields.append((progress.field(), ready.scene))
            return report(ready, progress, *rest)

        def writing(path: Path, data: bytes) -> None:
            write_atomically(path, data)
            self.written.append(path)
            if len(self.written) == self.last:
                raise KilledError

        def small(config: GridConfig, generator: torch.Generator) -> HashGrid:
            return HashGrid(replace(config, log2_table=8), generator)

        monkeypatch.setattr(vlgs.fields.language_field, "HashGrid", small)
        monkeypatch.setattr(vlgs.fields.radiance, "HashGrid", small)
        monkeypatch.setattr(vlgs.finish, "report", reporting)
        monkeypatch.setattr(vlgs.training.checkpoint, "write_atomically", writing)

    def __call__(self, results: Path, *overrides: str, last: int | None = None) -> Ran:
        self.written, self.last = [], last
        assert run(short(*overrides, f"results={results}")) == 0
        (path,) = (results / "runs").iterdir()
        folder = RunFolder(path)
        return Ran(folder, json.loads(folder.metrics.read_text()), *self.fields[-1], self.written)


@pytest.fixture
def runner(monkeypatch: pytest.MonkeyPatch) -> Runner:
    return Runner(monkeypatch)


@pytest.mark.parametrize("method", with_slow(METHODS, set(METHODS) - QUICK))
def test_it_trains_stops_goes_on_and_comes_back(tmp_path: Path, runner: Runner, method: str):
    chosen = (f"method={method}", *SHORTER.get(method, ()))
    whole = runner(tmp_path / "whole", *chosen, "threads=2")
    require_scores(whole)
    require_field(whole)

    with pytest.raises(KilledError):
        runner(tmp_path / "parts", *chosen, "threads=1", last=max(1, len(whole.written) - 1))
    parts = runner(tmp_path / "parts", *chosen, "threads=1")
    assert parts.folder.path.name == whole.folder.path.name
    assert len(parts.written) < len(whole.written), "what was made is not made again"
    require_same(parts, whole)

    require_opened(whole)
    whole.folder.metrics.unlink()
    back = runner(tmp_path / "whole", *chosen)
    assert not back.written
    require_same(back, whole)


def require_scores(ran: Ran) -> None:
    """Everything that a run of any system leaves behind."""
    assert ran.metrics["psnr"] > 5
    assert ran.metrics["train_seconds"] > 0
    language = ran.field.has_language
    assert (ran.metrics["miou"] is not None) == language
    assert (ran.metrics["loc_acc"] is not None) == language
    assert ran.metrics["failure"] is None
    clouds = list(ran.folder.path.rglob("point_cloud.ply"))
    assert bool(clouds) == isinstance(ran.field, HasGaussians)
    assert bool(ran.metrics["n_gaussians"]) == bool(clouds)
    assert ("n_gaussians" in ran.metrics["reasons"]) == (ran.metrics["n_gaussians"] is None)


def require_field(ran: Ran) -> None:
    """The contract of `Field`, and of `HasGaussians` where it is one."""
    field, camera = ran.field, ran.scene.test[0].camera
    size = (camera.height, camera.width)
    assert "color" in field.outputs
    images = field.render(camera, field.outputs)
    assert images.color is not None
    assert images.color.shape == (*size, 3)
    for name in field.outputs:
        image = getattr(images, name)
        assert torch.isfinite(image).all()
        alone = getattr(field.render(camera, frozenset({name})), name)
        torch.testing.assert_close(alone, image, rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="outputs must be some of"):
        field.render(camera, frozenset({"sound"}))
    if not field.has_language:
        return
    vocabulary = ran.scene.vocabulary
    assert vocabulary is not None
    words = vocabulary.vectors[:3]
    found = field.similarity(camera, words)
    assert found.shape == (len(field.levels()), 3, *size)
    assert torch.isfinite(found).all()
    assert found.abs().max() <= 1 + 1e-4
    assert found.std() > 0, "every word has the same answer everywhere"
    torch.testing.assert_close(field.similarity(camera, words, images), found)
    pixels = torch.tensor([0, 7, size[0] * size[1] - 1])
    some = field.similarity(camera, words, pixels=pixels)
    torch.testing.assert_close(some[:, :, 0], found.flatten(2)[:, :, pixels])
    if isinstance(field, HasGaussians):
        each = field.gaussian_similarity(words)
        assert each.shape == (len(field.levels()), 3, ran.metrics["n_gaussians"])
        assert torch.isfinite(each).all()
        for weight in (field.opacities(), field.language_weights()):
            assert ((weight >= 0) & (weight <= 1)).all()


def require_opened(ran: Ran) -> None:
    """The folder alone gives the same field, to the bit, and knows where the photographs were taken."""
    opened = open_run(ran.folder.path)
    views = [*ran.scene.train, *ran.scene.test]
    assert [one.name for one in opened.cameras()] == [view.name for view in views]
    camera = opened.cameras("test")[0].camera
    kept, first = opened.field, ran.field
    assert isinstance(kept, HasGaussians) == isinstance(first, HasGaussians)
    assert (kept.outputs, len(kept.levels())) == (first.outputs, len(first.levels()))
    one, other = kept.render(camera, kept.outputs), first.render(camera, first.outputs)
    for name in kept.outputs:
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    if not kept.has_language:
        with pytest.raises(ValueError, match="the field has no language"):
            opened.ask(["mug"])
        return
    asked = opened.ask(ran.scene.classes[:1])
    words = torch.randn(2, asked.prompts.text.shape[1])  # no class's, which a method may have moved
    assert torch.equal(kept.similarity(camera, words), first.similarity(camera, words))


def require_same(one: Ran, other: Ran) -> None:
    """Equal to the bit: all that is in checkpoints, and all scores."""
    a, b = tensors_of(one.folder), tensors_of(other.folder)
    assert a.keys() == b.keys()
    assert [name for name in a if not torch.equal(a[name], b[name])] == []
    for name in ("psnr", "ssim", "miou", "loc_acc", "per_view", "per_category", "n_gaussians"):
        assert one.metrics[name] == other.metrics[name], name


def tensors_of(folder: RunFolder) -> dict[str, torch.Tensor]:
    """Everything in the last checkpoint of every model of a run; NaN as a number of its own."""
    found = {}
    for place in sorted(folder.path.rglob("checkpoint")):
        checkpoint = load_checkpoint(place)
        assert checkpoint is not None
        name = place.relative_to(folder.path)
        for key, value in checkpoint.tensors.items():
            found[f"{name}/{key}"] = value.nan_to_num(-7.0) if value.is_floating_point() else value
    return found


@pytest.mark.parametrize("method", METHODS)
def test_its_file_says_what_it_is_and_what_it_costs(method: str):
    first = (CONF / "method" / f"{method}.yaml").read_text().splitlines()[1]
    assert first.startswith("# ")
    assert "Cost:" in first
    assert first[2:] in list_options("method")
