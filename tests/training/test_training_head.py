"""A head that is trained along with the Gaussians: its place in optimiser and checkpoint, and runs with it."""

import json
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from test_training_training import assert_same_bits
from tiny_runs import TINY, composed

from vlgs.config import instantiate
from vlgs.run import run
from vlgs.runs import RunFolder
from vlgs.training.build import Parts, build_module
from vlgs.training.fit import FitOptions, fit
from vlgs.training.lightning import VLGSModule
from vlgs.training.state import capture, restore
from vlgs.types import Scene

KEPT = tuple(o for o in TINY if not o.startswith("head."))
LINEAR = (*KEPT, "head=linear", "head.dim=6", "head.learning_rate=0.01", "fusion=none", "trainer=smoke")  # fmt: skip


def module_of(scene: Scene, *overrides: str) -> VLGSModule:
    config = composed(*LINEAR, "trainer.iterations=12", "gaussians.silent_above=1.0", *overrides)
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, config.seed)


def train(module: VLGSModule, folder: Path) -> VLGSModule:
    fit(module, RunFolder(folder), FitOptions(meta={}, progress=False))
    return module


def test_an_iteration_moves_it_and_what_is_not_finite_in_it_is_named(tiny_scene: Scene):
    module = module_of(tiny_scene)
    (group,) = (g for g in module.optimizer.param_groups if g["name"] == "head")
    assert group["lr"] == 0.01
    before = [parameter.detach().clone() for parameter in group["params"]]
    codes = module.model.splats["features"].detach().clone()
    for step in (0, 1):  # codes start at zero, so that the first moves but the bias
        module.training_step(step, 0)
    assert not any(map(torch.equal, before, group["params"]))
    assert not torch.equal(codes, module.model.splats["features"])  # through the head
    group["params"][0].register_hook(lambda gradient: gradient * torch.nan)
    with pytest.raises(FloatingPointError, match=r"gradient of head\.map\.weight must be finite"):
        module.training_step(2, 0)


@pytest.mark.usefixtures("unchecked")
def test_a_resumed_run_has_the_same_bits(tiny_scene: Scene, tmp_path: Path):
    densify = ("gaussians.densify={start: 2, stop: 10, every: 4, reset_every: 6}", "gaussians.densify.grad_threshold=1e-6")  # fmt: skip
    whole = train(module_of(tiny_scene, *densify), tmp_path / "whole")
    assert {"model.head.map.weight", "adam.head.0.exp_avg"} <= capture(whole, {}).tensors.keys()
    first = module_of(tiny_scene, *densify)
    original = first.training_step

    def stopping(step: int, batch_idx: int) -> None:
        original(step, batch_idx)
        first.trainer.should_stop = step + 1 == 5

    first.training_step = stopping  # type: ignore[method-assign]
    train(first, tmp_path / "parts")
    assert first.next_step == 5
    assert_same_bits(train(module_of(tiny_scene, *densify), tmp_path / "parts"), whole)


@pytest.mark.usefixtures("unchecked")
def test_it_learns_the_embeddings_of_the_masks(tiny_scene: Scene, tmp_path: Path):
    module = module_of(tiny_scene, "trainer.iterations=60", "loss.language.error=l1")

    def cosine() -> float:
        target = module.views[0]
        with torch.no_grad():
            feature = module.model.render(target.view.camera).feature
            assert feature is not None
            decoded = module.model.head.decode(feature)
        return float((decoded * target.codes).sum(dim=-1)[target.valid].mean())

    assert cosine() < 0.2
    train(module, tmp_path)
    assert cosine() > 0.85


@pytest.mark.usefixtures("unchecked")
def test_a_run_answers_at_every_level(tmp_path: Path):
    overrides = ("trainer.iterations=10", "pictures=false", "levels=joint")
    assert run(composed(*LINEAR, *overrides, f"results={tmp_path}")) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["levels"] == [1, 2, 3]
    assert metrics["miou"] is not None
    assert metrics["failure"] is None


def test_a_checkpoint_of_before_is_told_the_new_name(tiny_scene: Scene):
    made = capture(module_of(tiny_scene), {})
    tensors = {k.replace("model.head.", "model.codec."): v for k, v in made.tensors.items()}
    with pytest.raises(
        ValueError, match=r"must hold its head as head\.\*, got codec\.map\.bias, from"
    ):
        restore(module_of(tiny_scene), replace(made, tensors=tensors))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("gaussians.init_features=lifted",), "head must be autoencoder or identity or principal with gaussians.init_features=lifted, .* got linear"),
        (("sharing=lifted", "indicator=opacity"), "head must be autoencoder or identity or principal with sharing=lifted, as nothing trains it, got linear"),
        (("head.width=100",), "width must be the embedding width 512, got 100"),
        (("head.learning_rate=1.5",), "learning_rate must be 0 to 1, got 1.5"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(tmp_path: Path, overrides: tuple[str, ...], message: str):
    with pytest.raises(ValueError, match=message):
        run(composed(*LINEAR, *overrides, f"results={tmp_path}"))
