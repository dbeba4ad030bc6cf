"""The subcommands run, and their files say what they hold."""

import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from vlgs.bench.__main__ import SUBCOMMANDS, main
from vlgs.bench.growth import Point, run_growth
from vlgs.bench.kernel import BOUND_RATE, SIZES, Figures, Job, Size, _elsewhere, run_kernel
from vlgs.bench.record import provenance, read_record

HEADER = {"command", "cpu", "cores", "isa", "load", "commit", "seed", "torch"}
TIMES = {f"{way}_{what}" for way in ("forward", "backward") for what in ("ms", "q1", "q3", "cpu")}


def header(path: Path) -> set[str]:
    lines = [line for line in path.read_text().splitlines() if line.startswith("# ")]
    return {line[2:].partition(":")[0] for line in lines}


@pytest.mark.slow
def test_kernel_times_both_parts_and_the_reference(tmp_path: Path):
    size = Size(60, 32, 24, 1.0, Figures(2.0, (6.0, 3.0)), Figures(4.0, (16.0, 8.0)))
    dense = [Size(20, 16, 12)]
    rows = run_kernel([size], dense, [3, 5, 16], [1], ["base"], 2, tmp_path)
    table = read_record(tmp_path / "kernel.csv")
    assert header(tmp_path / "kernel.csv") >= HEADER
    assert set(table) >= TIMES | {"job_threads", "isa", "repeats", "opensplat_ms", "ratio"}
    assert list(table.job_part) == ["call", "blend"] * 3 + ["call", "reference"]
    assert list(table.isa) == ["base"] * 7 + ["torch"]
    assert (table.forward_ms > 0).all()
    assert rows[0].ratio == pytest.approx(1.0 / (rows[0].forward.ms + rows[0].backward.ms))
    assert table.opensplat_ms.notna().tolist() == [True] * 2 + [False] * 6
    # Bound and targets are of projected splats with 3 + 3 and 3 + 16 channels, the bound on two threads, on another machine.
    for column in (table.bound_ms, table.target_ms):
        assert column.notna().tolist() == [False, True, False, False, False, True, False, False]
    rate = re.search(r"multiply_add_rate: ([0-9.]+) G/s", (tmp_path / "kernel.csv").read_text())
    assert rate is not None
    slower = BOUND_RATE / float(rate[1])
    for row, bound, target in ((1, 2.0, 6.0), (5, 4.0, 16.0)):
        time = table.forward_ms[row] + table.backward_ms[row]
        assert table.bound_ms[row] == pytest.approx(2 * bound * slower, rel=0.01)
        assert table.target_ms[row] == pytest.approx(target * slower, rel=0.01)
        for over, than in (("over_bound", "bound_ms"), ("over_target", "target_ms")):
            # Six digits are written.
            assert table[over][row] == pytest.approx(time / table[than][row], rel=1e-4)


def test_bounds_and_targets_are_of_as_many_threads():
    job = Job(*SIZES[0][:3], channels=16, threads=2, part="blend")
    assert _elsewhere(SIZES[0], job, BOUND_RATE) == (8.7, 12.1)
    assert _elsewhere(SIZES[0], replace(job, threads=1), BOUND_RATE) == (2 * 8.7, 22.9)
    assert _elsewhere(SIZES[0], replace(job, threads=4), BOUND_RATE) == (8.7 / 2, None)
    assert _elsewhere(SIZES[0], replace(job, channels=512), BOUND_RATE) == (None, None)
    assert _elsewhere(SIZES[0], replace(job, part="call"), BOUND_RATE) == (None, None)
    for size in SIZES:
        for known in (size.figures(3), size.figures(16)):
            assert known is not None
            one, two = known.targets
            assert known.bound < two < one


@pytest.mark.slow
def test_growth_has_slopes_within_a_series(tmp_path: Path):
    points = [Point("gaussians", n, n, 16, 12, 3, 1) for n in (20, 40)]
    points += [Point("channels", c, 20, 16, 12, c, 1) for c in (1, 4)]
    run_growth(points, 2, tmp_path, seed=0)
    table = read_record(tmp_path / "growth.csv")
    assert set(table) >= TIMES | {"point_axis", "point_value", "slope"}
    assert table.slope.notna().tolist() == [False, True, False, True]
    assert (tmp_path / "growth.png").stat().st_size > 0
    assert (tmp_path / "growth.pdf").stat().st_size > 0


@pytest.mark.slow
def test_reading_and_protocols_leave_their_stages_and_costs(tmp_path: Path):
    for name in ("reading", "protocols"):
        assert main([name, "--quick", "--out", str(tmp_path)]) == 0
        assert header(tmp_path / f"{name}.csv") >= HEADER
        table = read_record(tmp_path / f"{name}.csv")
        assert ((table.wall_seconds > 0) & (table.cpu_seconds > 0) & (table.peak_mib > 50)).all()
    reading, protocols = (read_record(tmp_path / f"{n}.csv") for n in ("reading", "protocols"))
    for _, stages in reading.groupby("language"):
        assert list(stages.stage)[:4] == [
            *("imports", "scene read", "Gaussians and head", "first step")
        ]
        for growing in ("wall_seconds", "cpu_seconds", "peak_mib"):
            assert stages[growing].is_monotonic_increasing
    assert list(reading.language.unique()) == ["none", "head fitted", "head cached"]
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


def test_ctrl_c_is_one_line_and_status_130(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("vlgs.bench.train.run_train", interrupted)
    assert main(["train", "--quick", "--out", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert said.startswith("stopped; ")
    assert said.count("\n") == 1


@pytest.mark.parametrize("former", ["stress", "fuzz"])
def test_a_former_subcommand_says_where_it_went(former: str, capsys: pytest.CaptureFixture[str]):
    assert main([former, "--quick"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    module = re.search(r"python -m (tests\.\w+)", said)
    assert module is not None
    assert find_spec(f"{module[1]}.__main__")


def test_a_header_repeats_the_command_without_the_folders_of_this_machine(
    monkeypatch: pytest.MonkeyPatch,
):
    given = ["vlgs.bench", "unseen", "--root", "/somewhere/else/data", "--override", "a=[b, c]"]
    monkeypatch.setattr("sys.argv", given)
    command = provenance(None)["command"]
    assert command == "python -m vlgs.bench unseen --root data --override 'a=[b, c]'"
