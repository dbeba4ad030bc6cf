"""The subcommands run, and their files say what they hold."""

import re
from pathlib import Path

import pytest

from vlgs.bench.__main__ import SUBCOMMANDS, main
from vlgs.bench.growth import Point, run_growth
from vlgs.bench.kernel import BOUND_RATE, Size, run_kernel
from vlgs.bench.sheet import read_sheet

HEADER = {"command", "cpu", "cores", "isa", "load", "commit", "seed", "torch"}
TIMES = {f"{way}_{what}" for way in ("forward", "backward") for what in ("ms", "q1", "q3", "cpu")}


def header(path: Path) -> set[str]:
    lines = [line for line in path.read_text().splitlines() if line.startswith("# ")]
    return {line[2:].partition(":")[0] for line in lines}


def test_kernel_times_both_parts_and_the_reference(tmp_path: Path):
    rows = run_kernel(
        [Size(60, 32, 24, 1.0, 2.0)], [Size(20, 16, 12)], [3, 5], [1], ["base"], 2, tmp_path
    )
    table = read_sheet(tmp_path / "kernel.csv")
    assert header(tmp_path / "kernel.csv") >= HEADER
    assert set(table) >= TIMES | {"job_threads", "isa", "repeats", "opensplat_ms", "ratio"}
    assert list(table.job_part) == ["call", "blend"] * 2 + ["call", "reference"]
    assert list(table.isa) == ["base"] * 5 + ["torch"]
    assert (table.forward_ms > 0).all()
    assert rows[0].ratio == pytest.approx(1.0 / (rows[0].forward.ms + rows[0].backward.ms))
    assert table.opensplat_ms.notna().tolist() == [True, True, False, False, False, False]
    # The bound is that of projected splats with 3 + 3 channels on two threads and another machine.
    assert table.bound_ms.notna().tolist() == [False, True, False, False, False, False]
    rate = re.search(r"multiply_add_rate: ([0-9.]+) G/s", (tmp_path / "kernel.csv").read_text())
    assert rate is not None
    assert table.bound_ms[1] == pytest.approx(2 * 2.0 * BOUND_RATE / float(rate[1]), rel=0.01)
    assert table.over_bound[1] == pytest.approx(
        (table.forward_ms[1] + table.backward_ms[1]) / table.bound_ms[1], rel=1e-4
    )  # six digits are written


def test_growth_has_slopes_within_a_series(tmp_path: Path):
    points = [Point("gaussians", n, n, 16, 12, 3, 1) for n in (20, 40)]
    points += [Point("channels", c, 20, 16, 12, c, 1) for c in (1, 4)]
    run_growth(points, 2, tmp_path, seed=0)
    table = read_sheet(tmp_path / "growth.csv")
    assert set(table) >= TIMES | {"point_axis", "point_value", "slope"}
    assert table.slope.notna().tolist() == [False, True, False, True]
    assert (tmp_path / "growth.png").stat().st_size > 0
    assert (tmp_path / "growth.pdf").stat().st_size > 0


@pytest.mark.slow
def test_reading_and_protocols_leave_their_stages_and_costs(tmp_path: Path):
    for name in ("reading", "protocols"):
        assert main([name, "--quick", "--out", str(tmp_path)]) == 0
        assert header(tmp_path / f"{name}.csv") >= HEADER
        table = read_sheet(tmp_path / f"{name}.csv")
        assert ((table.wall_seconds > 0) & (table.cpu_seconds > 0) & (table.peak_mib > 50)).all()
    reading, protocols = (read_sheet(tmp_path / f"{n}.csv") for n in ("reading", "protocols"))
    for _, stages in reading.groupby("language"):
        assert list(stages.stage)[:4] == [
            *("imports", "scene read", "Gaussians and codec", "first step")
        ]
        for growing in ("wall_seconds", "cpu_seconds", "peak_mib"):
            assert stages[growing].is_monotonic_increasing
    assert list(reading.language.unique()) == [False, True]
    assert set(protocols.protocol) >= {"dense", "lerf_ovs", "lerf_ovs (v2)", "select3d"}


def test_every_subcommand_says_what_it_does(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert all(subcommand.__name__ in text for subcommand in SUBCOMMANDS)


def test_bad_input_is_one_line_and_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["pareto", "--out", str(tmp_path)]) == 1
    assert "python -m vlgs.bench error makes it" in capsys.readouterr().err
    assert main(["error", "--run", str(tmp_path)]) == 1
    assert "must be a run folder with a checkpoint" in capsys.readouterr().err
    assert main(["train", "--recipes", "soup", "--out", str(tmp_path)]) == 1
    assert "recipe must be one of default" in capsys.readouterr().err
