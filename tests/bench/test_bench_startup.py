"""What a run costs beside its training."""

import time
from pathlib import Path

import pytest

from vlgs.bench.__main__ import main
from vlgs.bench.record import read_record
from vlgs.bench.startup_child import Parts


def test_what_is_inside_of_another_part_is_counted_there_alone(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr(time, "process_time", lambda: now[0])
    monkeypatch.setattr(time, "perf_counter", lambda: 2 * now[0])
    parts = Parts()

    def pass_time(seconds: float) -> None:
        now[0] += seconds

    inner = parts.timed("inner", pass_time)
    reached = parts.reach("reached", pass_time)

    def work() -> None:
        inner(1.0)
        pass_time(10.0)
        inner(2.0)
        reached(4.0)
        reached(8.0)

    parts.timed("outer", work)()
    assert parts.seconds["inner"] == (3.0, 6.0)
    assert parts.seconds["outer"] == (22.0, 44.0)
    assert parts.seconds["reached"] == (13.0, 26.0)


@pytest.mark.slow
def test_startup_says_where_a_run_spends_its_time(tmp_path: Path):
    assert main(["startup", "--quick", "--no-sweep", "--out", str(tmp_path)]) == 0
    table = read_record(tmp_path / "startup.csv")
    assert set(table.command) == {"help", "run"}
    for _, run in table[table.command == "run"].groupby("state"):
        seconds = run.set_index("part").cpu_seconds
        together = seconds.drop(["all", "first step"]).sum()
        assert seconds["first step"] < together
        assert together == pytest.approx(seconds["all"], rel=0.3)
