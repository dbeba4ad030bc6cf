"""Runs that train several models and evaluate them together."""

import json
from pathlib import Path

import pytest
import torch
from slow import with_slow
from tiny_runs import TINY, composed

import vlgs.training.workshop
from vlgs.run import run
from vlgs.runs import STOPPED, RunFolder
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.fit import fit
from vlgs.training.lightning import VLGSModule

SHORT = (*TINY, "trainer=smoke", "trainer.iterations=30", "pictures=false", "threads=1")
SEPARATE = ("sharing=none", "fusion=none")
LIFTED = ("sharing=lifted", "fusion=none", "indicator=opacity", "blend=none")
KINDS = {
    "sharing=none": (SEPARATE, {"color", "language"}),
    "levels=separate": (("levels=separate",), {"level_1", "level_2", "level_3"}),
    "levels=joint": (("levels=joint",), {""}),
    "joint, an indicator for each level": (
        ("levels=joint", "indicator=per_level", "augment=offline", "augment.views=2", *SEPARATE),
        {"augment", "color", "language"},
    ),
    "sharing=lifted": ((*LIFTED, "levels=joint"), {"geometry", ""}),
    "augment=offline": (("augment=offline", "augment.views=3"), {"augment", ""}),
    "all of it": (
        ("levels=separate", "augment=offline", "augment.views=2", *SEPARATE),
        {
            *("augment", "color"),
            *("level_1/language", "level_2/language", "level_3/language"),
        },
    ),
}


def only_run(results: Path) -> RunFolder:
    (path,) = (results / "runs").iterdir()
    return RunFolder(path)


def metrics_of(folder: RunFolder) -> dict:
    return json.loads(folder.metrics.read_text())


@pytest.mark.parametrize(
    "kind", with_slow(KINDS, set(KINDS) - {"joint, an indicator for each level"})
)
def test_every_model_has_a_folder_and_the_run_one_result(tmp_path: Path, kind: str):
    overrides, stages = KINDS[kind]
    config = composed(*SHORT, *overrides, f"results={tmp_path}")
    config.pictures = kind in ("sharing=none", "levels=joint")
    assert run(config) == 0
    folder = only_run(tmp_path)
    metrics = metrics_of(folder)
    found = {str(path.parent.relative_to(folder.path)) for path in folder.path.rglob("*.ply")}
    assert {"" if name == "." else name for name in found} == stages - {"augment", "geometry"}
    for name in stages:
        stage = RunFolder(folder.path / name)
        assert load_checkpoint(stage.checkpoint).step == 30  # type: ignore[union-attr]
        assert stage.curves.is_file() or (kind == "sharing=lifted" and name == "")
    assert metrics["levels"] == ([3] if config.levels == "single" else [1, 2, 3])
    assert metrics["level_models"] == config.levels
    assert metrics["psnr"] > 8
    assert metrics["miou"] is not None
    assert metrics["train_seconds"] > 0
    assert metrics["test_views_seen"] == 0
    queries = json.loads(folder.queries.read_text())
    assert {row["level"] for row in queries} <= {None, *range(len(metrics["levels"]))}
    assert (folder.renders / "overview.png").is_file() == config.pictures
    of_which = "of the model of mask level 3, as are frame rates; psnr and ssim of that of 1"
    told = of_which if config.levels == "separate" else None
    assert metrics["reasons"].get("pictures") == told


RESUMED = {
    "sharing=none": (SEPARATE, 2),
    "sharing=lifted": (LIFTED, 1),
    "levels=separate": (("levels=separate",), 3),
    "augment=offline": (("augment=offline", "augment.views=2"), 2),
}
"""Overrides, and how many models are trained."""


@pytest.mark.parametrize("kind", with_slow(RESUMED, set(RESUMED) - {"sharing=none"}))
def test_stopped_in_the_second_stage_it_goes_on_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
):
    chosen, trained = RESUMED[kind]
    overrides = (*SHORT, "trainer.iterations=16", *chosen)
    assert run(composed(*overrides, f"results={tmp_path / 'whole'}")) == 0
    whole = only_run(tmp_path / "whole")

    steps, lifts = 0, 0
    step_of, lift = VLGSModule.training_step, vlgs.training.workshop.lift_features

    def stopping(self: VLGSModule, step: int, batch_idx: int) -> None:
        nonlocal steps
        step_of(self, step, batch_idx)
        steps += 1
        self.trainer.should_stop = steps == 16 + 14

    def fit_until_stopped(module: VLGSModule, *rest: object) -> str | None:
        fit(module, *rest)  # type: ignore[arg-type]
        return None if module.next_step == module.settings.iterations else "SIGINT"

    def lift_until_killed(module: VLGSModule) -> None:
        nonlocal lifts
        lift(module)
        lifts += 1
        if lifts == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(VLGSModule, "training_step", stopping)
    monkeypatch.setattr("vlgs.training.workshop.fit", fit_until_stopped)
    monkeypatch.setattr("vlgs.training.workshop.lift_features", lift_until_killed)
    config = composed(*overrides, f"results={tmp_path / 'parts'}")
    try:
        assert run(config) == STOPPED
    except KeyboardInterrupt:
        assert kind == "sharing=lifted"
    assert run(config) == 0
    assert steps == 16 * trained, "no step is done twice"
    parts = only_run(tmp_path / "parts")
    assert parts.path.name == whole.path.name
    one, two = tensors_of(whole), tensors_of(parts)
    torch.testing.assert_close(one, two, rtol=0, atol=0, equal_nan=True)
    scores = ("psnr", "miou", "per_view", "n_gaussians", "per_category")
    assert [metrics_of(parts)[k] for k in scores] == [metrics_of(whole)[k] for k in scores]


def tensors_of(folder: RunFolder) -> dict[str, torch.Tensor]:
    """Everything in the last checkpoint of every model of a run."""
    found = {}
    for place in folder.path.rglob("checkpoint"):
        checkpoint = load_checkpoint(place)
        assert checkpoint is not None
        name = place.relative_to(folder.path)
        found |= {f"{name}/{key}": value for key, value in checkpoint.tensors.items()}
    return found


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["sharing=none"], "fusion must be none with sharing=none, as .* not both, got self"),
        (["levels=both"], "levels must be single or separate or joint, got both"),
        (["indicator=per_level"], "levels must be joint with indicator=per_level, got single"),
        (["sharing=lifted"], "fusion must be none with sharing=lifted, as .*, got self"),
        (
            ["sharing=lifted", "fusion=none"],
            "indicator must be fixed or opacity with sharing=lifted",
        ),
        (["augment=offline", "augment.views=0"], "views must be 1 to 100000, got 0"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(
    tmp_path: Path, overrides: list[str], message: str
):
    with pytest.raises(ValueError, match=message):
        run(composed(*SHORT, *overrides, f"results={tmp_path}"))
    assert not (tmp_path / "runs").exists()
