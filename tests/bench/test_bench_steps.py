"""Switches of a training step: measured where they take effect, and a broken promise is seen."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from vlgs.bench import error, steps
from vlgs.bench.checks import Check, violated
from vlgs.bench.one_step import StepSwitch, measure_step, run_step, step_switches, turned
from vlgs.bench.presets import Trained, train_a_little
from vlgs.bench.record import read_record
from vlgs.bench.steps import measure_switches
from vlgs.bench.train import QUICK
from vlgs.bench.workload import make_workload
from vlgs.ops.cached_weights import CachedView
from vlgs.skips import SKIPS
from vlgs.training.state import capture
from vlgs.types import Camera
from vlgs.view_blend import blend_camera
from vlgs.view_blend.ratio import FixedBlend


@pytest.fixture(scope="module")
def trained() -> Trained:
    return train_a_little([*QUICK, "head.cache_dir=null", "progress=false"], steps=20)


def test_every_switch_of_training_has_a_row_and_keeps_its_promise(trained: Trained):
    before = capture(trained.module, {})
    rows, checks = measure_switches("q", trained.module, 1, 1, draws=60)
    assert violated(checks) == []
    assert [c.bound for c in checks if not c.bound] == [0.0], "blend_zero"
    after = capture(trained.module, {})
    assert after.step == before.step
    assert all(torch.equal(after.tensors[k], before.tensors[k]) for k in before.tensors)

    wanted = [s.name for s in SKIPS if s.setting.startswith("trainer.")]
    assert [row.switch for row in rows] == [s.skip.name for s in step_switches()] == wanted
    by_name = {row.switch: row for row in rows}
    assert all(row.off_backward.ms > 0 and row.on_forward.ms > 0 for row in rows)
    small, reuse, frozen = (
        by_name[name] for name in ("blend_small", "blend_reuse", "frozen_weights")
    )
    assert small.loss_bound is not None
    assert 0 < small.loss_error <= small.loss_bound
    assert reuse.loss_error > 0
    for row in (small, reuse):
        assert row.skipped is not None
        assert 0.1 < row.skipped < 0.95
    # Some 42 % of the draws of Beta(0.2, 0.2), of which there are 60.
    assert reuse.skipped == pytest.approx(0.42, abs=0.2)
    assert by_name["blend_zero"].skipped == 0
    assert frozen.skipped == 1
    assert frozen.kept_mib is not None
    assert frozen.kept_mib > 0
    assert [name for name, l2 in frozen.l2.items() if l2 is not None] == ["splats.features"]


def test_a_skip_that_moves_numbers_breaks_its_promise(
    trained: Trained, monkeypatch: pytest.MonkeyPatch
):
    product = CachedView.render
    monkeypatch.setattr(CachedView, "render", lambda self, v: 0.9999 * product(self, v))
    broken = violated(measure_switches("q", trained.module, 1, 1, draws=20)[1])
    assert [c.promise.partition(":")[0] for c in broken] == ["frozen_weights"]


def test_bounds_are_tight_enough_to_be_broken(trained: Trained, monkeypatch: pytest.MonkeyPatch):
    """Skips that leave out more than they state."""
    wrong = {
        "blend_small": {"blend_weight": 2.0},
        "blend_reuse": {"blend_reuse": 0.1},
    }
    right = StepSwitch.setting

    def setting(self: StepSwitch, on: bool) -> dict[str, Any]:
        return wrong.get(self.skip.name, right(self, on)) if on else right(self, on)

    monkeypatch.setattr(StepSwitch, "setting", setting)
    broken = violated(measure_switches("q", trained.module, 1, 1, draws=60)[1])
    assert [c.promise.partition(":")[0] for c in broken] == ["blend_small", "blend_reuse"]


def test_a_step_can_be_taken_again(trained: Trained):
    module = turned(trained.module, step_switches()[0], on=False)
    step = module.next_step
    first, second = (measure_step(module, step) for _ in "ab")
    assert first.loss == second.loss
    assert first.blended == second.blended
    names = {name for name, p in module.model.named_parameters() if p.requires_grad}
    assert set(first.outcome.gradients) == names
    assert all(
        torch.equal(first.outcome.gradients[n], second.outcome.gradients[n])
        for n in first.outcome.gradients
    )
    assert module.next_step == step
    times = run_step(module, step)
    assert min(times) > 0


def test_the_detour_of_a_blended_camera_is_its_ratio():
    def at(angle: float, x: float) -> Camera:
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 0] = viewmat[2, 2] = math.cos(angle)
        viewmat[0, 2], viewmat[2, 0] = math.sin(angle), -math.sin(angle)
        viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([x, 0.0, 0.0], dtype=torch.float64)
        return Camera(viewmat, torch.eye(3), 4, 3)

    first, second = at(0.3, 1.0), at(-0.2, 3.0)
    between = blend_camera(first, second, 0.75, FixedBlend(value=0.75))
    assert steps._detour(first, between, first, second) == pytest.approx(0.25, rel=1e-9)
    assert steps._detour(between, between, first, second) == 0


@pytest.mark.slow
def test_rows_go_into_a_file_of_their_own(
    tmp_path: Path, trained: Trained, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(steps, "STEPS", 1)
    monkeypatch.setattr(error, "_measure", lambda *_: [Check("s", "p", 0.0, 0.0)])
    monkeypatch.setattr(error, "_print", lambda _: None)
    scene = {"tiny": make_workload(60, 16, 16)}
    assert error.run_error(scene, None, [1], 1, tmp_path, 0, trained) == []
    table = read_record(tmp_path / "error_steps.csv")
    assert set(table) >= {
        "scene", "switch", "on_forward_ms", "off_backward_cpu", "skipped", "loss_error", "loss_bound",
        "image_max", "l2_splats.features", "cos_fusion.qkv.weight",
    }  # fmt: skip
    promises = read_record(tmp_path / "error_checks.csv").promise
    assert "blend_reuse: on against off, camera" in list(promises)
