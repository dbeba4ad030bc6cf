"""Errors are seen where there are some, and a broken promise is status 1."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from vlgs.bench import __main__, checks, error, outcome, switches
from vlgs.bench.checks import check_dense, check_presets, check_rounding, violated
from vlgs.bench.memory import measure_memory
from vlgs.bench.pareto import front, run_pareto
from vlgs.bench.presets import raster_presets
from vlgs.bench.record import read_record
from vlgs.bench.scenes import (
    LEAVES,
    in_precision,
    load_workload,
    save_workload,
    with_one_weight,
)
from vlgs.bench.switches import check_switch, raster_switches
from vlgs.bench.workload import Workload, make_workload
from vlgs.ops.project import project
from vlgs.ops.rasterize_to_pixels import count_work
from vlgs.types import RasterConfig


@pytest.fixture
def w() -> Workload:
    return make_workload(120, 32, 24)


def test_the_truth_without_cutoffs_is_the_plain_sum(w: Workload):
    """Against alpha blending written out, without any test or clamp."""
    true = in_precision(w, torch.float64)
    config = outcome.without_cutoffs(RasterConfig())
    got = outcome.outcome(true, config)
    smallest = replace(config, alpha_min=1e-30)
    plain = outcome.outcome(true, smallest, "reference")
    errors = outcome.compare(got, plain)
    assert errors.image_max < 1e-11
    assert errors.gradient < 1e-9


def test_errors_are_the_norms_that_they_are_called(w: Workload):
    true = outcome.outcome(in_precision(w, torch.float64), RasterConfig())
    got = outcome.RasterOutcome(
        (true.images[0] + 0.25, true.images[1]),
        {**true.gradients, "means": -2 * true.gradients["means"]},
    )
    errors = outcome.compare(got, true)
    assert errors.image_max == pytest.approx(0.25)
    assert errors.image_mean == pytest.approx(0.125)
    assert errors.l2["means"] == pytest.approx(3.0)
    assert errors.cos["means"] == pytest.approx(-1.0)
    assert [errors.l2[name] for name in LEAVES if name != "means"] == [0.0] * 6
    assert errors.gradient == pytest.approx(3.0)


def test_promises_hold_and_a_wrong_kernel_breaks_them(w: Workload, monkeypatch: pytest.MonkeyPatch):
    presets = raster_presets()
    kept = check_dense(presets, 0) + check_presets("w", w, presets) + check_rounding("w", w)
    assert violated(kept) == []
    right = outcome.rasterize

    def wrong(*args: Any, backend: Any = "cpu", **kwargs: Any):
        out = right(*args, backend=backend, **kwargs)
        if backend == "reference" or args[0].dtype == torch.float64:
            return out
        return replace(out, images=tuple(1.001 * image for image in out.images))

    monkeypatch.setattr(outcome, "rasterize", wrong)
    broken = violated(check_rounding("w", w))
    assert {check.promise for check in broken} == {"float32: image", "float32: gradients"}


def test_a_wrong_float64_kernel_differs_from_the_reference(monkeypatch: pytest.MonkeyPatch):
    right = outcome.rasterize

    def wrong(*args: Any, backend: Any = "cpu", **kwargs: Any):
        out = right(*args, backend=backend, **kwargs)
        scale = 1.0 if backend == "reference" else 1 + 1e-8
        return replace(out, images=tuple(scale * image for image in out.images))

    monkeypatch.setattr(outcome, "rasterize", wrong)
    assert len(violated(check_dense(raster_presets(), 0))) == 3


def test_switches_hold_on_one_weight_too(w: Workload):
    for scene in (w, with_one_weight(w)):
        measured = [c for switch in raster_switches() for c in check_switch("w", scene, switch)]
        assert violated(measured) == []
        # The same bits where that is the promise.
        assert [c.bound for c in measured[:4]] == [0.0, 0.0, 0.0, checks.EXACT]


def one_tile(gaussians: int) -> Workload:
    """As many behind each other, each of which covers all of one tile up to the clamp."""
    w = in_precision(make_workload(gaussians, 16, 16), torch.float32)
    means = torch.zeros(gaussians, 3)
    means[:, 2] = torch.arange(gaussians) + 2.0
    ones = torch.ones(gaussians)
    color, language = (replace(group, weight=ones) for group in w.groups)
    scales = torch.full((gaussians, 3), 1e3)
    return w._replace(means=means, scales=scales, groups=(color, language))


def test_skipped_work_is_counted_by_hand():
    """0.01 of the light is left behind one, 1e-4 behind two: the third crosses the threshold, and the other two are not reached."""
    w, config = one_tile(5), RasterConfig(transmittance_min=1e-5)
    count = switches._count(w, config)
    assert count == (5, 3 * 16)  # one chain, as both groups have one weight
    assert switches._count(w, replace(config, share_chains=False)) == (5, 2 * 3 * 16)
    assert switches._count(w, replace(config, transmittance_min=0.0)) == (5, 5 * 16)
    shares = {s.skip.name: switches.skipped_share(w, s) for s in raster_switches()}
    assert shares["shared_chain"] == 0.5
    assert shares["tile_test"] == shares["block_masks"] == 0
    assert 0 < shares["early_stop"] < 1


def test_skipped_blocks_are_those_of_the_masks():
    """Without masks and stop every entry of a list is weighed in all 16 blocks, on each of two chains."""
    w, off = make_workload(120, 32, 48), RasterConfig(block_masks=False, transmittance_min=0.0)
    entries, weighed = switches._count(w, off)
    assert weighed == entries * 16 * 2
    by_masks = switches._count(w, replace(off, block_masks=True))
    assert by_masks.entries == entries
    assert entries < by_masks.weighed < weighed
    boxes = switches._count(w, replace(off, tile_test=False))
    assert boxes.entries > entries
    # More chains than one pass over the tiles carries.
    splats = project(w.means, w.quats, w.scales, w.camera, off)
    groups = [replace(w.groups[0], weight=w.groups[0].weight.clone()) for _ in range(5)]
    n = count_work(splats, groups[:1], w.camera, off).entries
    assert count_work(splats, groups, w.camera, off) == (n, 5 * 16 * n)
    with pytest.raises(ValueError, match="stop must be after where work is counted, got before"):
        switches._count(w, replace(off, stop="before"))


def test_not_a_number_keeps_no_promise():
    assert violated([checks.Check("s", "p", float("nan"), 1.0)])


def test_a_workload_survives_the_disk(w: Workload, tmp_path: Path):
    for i, scene in enumerate((w, with_one_weight(in_precision(w, torch.float64)))):
        path = tmp_path / f"{i}.safetensors"
        save_workload(path, scene)
        again = load_workload(path)
        for a, b in zip(again.leaves(), scene.leaves(), strict=True):
            assert torch.equal(a, b)
            assert a.requires_grad
        shared = again.groups[0].weight is again.groups[1].weight
        assert shared == (i == 1)


@pytest.mark.slow
def test_memory_grows_with_the_image(tmp_path: Path):
    small, large = tmp_path / "small", tmp_path / "large"
    save_workload(small, make_workload(50, 32, 24, channels=64))
    save_workload(large, make_workload(50, 640, 480, channels=64))
    extra = [measure_memory(path, RasterConfig(), 1).extra_mib for path in (small, large)]
    # The image of 64 channels alone is 75 MiB.
    assert extra[1] - extra[0] > 75


@pytest.mark.slow
def test_error_and_pareto_write_their_files(tmp_path: Path, w: Workload):
    assert error.run_error({"tiny": w}, None, [1], 1, tmp_path, 0) == []
    table = read_record(tmp_path / "error.csv")
    assert set(table) >= {
        "scene", "variant", "precision", "threads", "truth", "forward_ms", "backward_cpu", "skipped",
        "memory_rss_mib", "memory_extra_mib", "error_image_max", "error_image_mean",
        *(f"error_{kind}_{name}" for kind in ("l2", "cos") for name in LEAVES),
        "quality_psnr", "quality_miou_change",
    }  # fmt: skip
    assert {"exact", "default", "fast", "early_stop off"} <= set(table.variant)
    assert (table.skipped.notna() == (table.group == "switch")).all()
    double = table[(table.precision == "float64") & (table.truth == "same_cutoffs")]
    assert (double.error_image_max == 0).all()
    assert (table[table.truth == "no_cutoffs"].error_image_max > 0).all()
    run_pareto(tmp_path)
    for name in ("pareto.png", "pareto_rounding.pdf"):
        assert (tmp_path / name).stat().st_size > 0
    points = read_record(tmp_path / "pareto.csv")
    assert points.groupby(["scene", "truth"]).front_worst_gradient.any().all()


@pytest.mark.slow
def test_a_broken_bound_is_status_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(error, "_measure", lambda *_: [checks.Check("s", "p", 0.0, 0.0)])
    monkeypatch.setattr(error, "_print", lambda _: None)
    arguments = ["error", "--quick", "--no-trained", "--out", str(tmp_path)]
    assert __main__.main(arguments) == 0
    monkeypatch.setattr(checks, "EXACT", -1.0)
    assert __main__.main(arguments) == 1
    assert "shared_chain: on against off must be at most -1.00e+00" in capsys.readouterr().err
    assert switches.raster_switches()


def test_front_on_points_made_by_hand():
    points = [(1.0, 5.0), (2.0, 2.0), (3.0, 2.0), (4.0, 1.0), (5.0, 1.0)]
    assert front(points) == [True, True, False, True, False]
    assert front([(1.0, 1.0), (1.0, 1.0)]) == [True, True]
    assert front([(2.0, 1.0), (1.0, 2.0), (2.0, 2.0)]) == [True, True, False]
    assert front([]) == []
