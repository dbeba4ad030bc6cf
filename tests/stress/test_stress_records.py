"""Records of the stress cases and of the fuzz: written as they go, continued on the same code, begun again on other code."""

from pathlib import Path

import pytest

from tests.fuzz_kernel import FuzzReport
from tests.fuzz_kernel import record as fuzz_record
from tests.fuzz_kernel.record import CHUNK, run_fuzz
from tests.stress import record
from tests.stress.case import Case, Verdict
from tests.stress.record import run_cases
from vlgs.bench.record import read_record


@pytest.fixture
def code(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The commit that the modules believe to be at."""
    now = ["a" * 40]
    for module in (fuzz_record, record):
        monkeypatch.setattr(module, "commit_with", lambda folder: now[0])
        monkeypatch.setattr(module, "same_code_with", lambda folder, one, other: one == other)
    return now


class Runs:
    """Runs nothing, and notes what it was asked for."""

    def __init__(self, failing: int | None = None) -> None:
        self.asked: list[range] = []
        self.failing = failing

    def __call__(self, seeds: range) -> FuzzReport:
        self.asked.append(seeds)
        bad: dict[int, str] = {}
        if self.failing is not None and self.failing in seeds:
            bad[self.failing] = "it broke"
        return FuzzReport(finite=len(seeds) - 1 - len(bad), refused=1, failures=bad)


def test_the_fuzz_continues_where_it_ended(tmp_path: Path, code: list[str]):
    path = tmp_path / "fuzz.csv"
    first, second, third = Runs(), Runs(), Runs()
    run_fuzz("v4", "none", CHUNK + 100, first, path)
    row = run_fuzz("v4", "none", 2 * CHUNK, second, path)
    assert first.asked == [range(CHUNK), range(CHUNK, CHUNK + 100)]
    assert second.asked == [range(CHUNK + 100, 2 * CHUNK)]
    assert (row.scenes, row.refused, row.finite) == (2 * CHUNK, 3, 2 * CHUNK - 3)
    run_fuzz("v3", "none", 10, third, path)
    run_fuzz("v4", "address", 20, third, path)
    found = read_record(path)
    assert list(zip(found.isa, found.sanitizers, found.scenes, strict=True)) == [
        ("v4", "address", 20),
        ("v3", "none", 10),
        ("v4", "none", 2 * CHUNK),
    ]


def test_other_code_begins_the_fuzz_again(tmp_path: Path, code: list[str]):
    path, again = tmp_path / "fuzz.csv", Runs()
    run_fuzz("v4", "none", 50, Runs(), path)
    code[0] = "b" * 40
    run_fuzz("v4", "none", 40, again, path)
    assert again.asked == [range(40)]
    found = read_record(path)
    assert list(found.scenes) == [40]
    assert list(found.commit) == ["b" * 40]


def test_a_failure_is_recorded_and_run_again(tmp_path: Path, code: list[str]):
    path, broken, mended = tmp_path / "fuzz.csv", Runs(failing=CHUNK + 3), Runs()
    row = run_fuzz("v4", "none", 3 * CHUNK, broken, path)
    assert len(broken.asked) == 2, "what comes after a failure is not run"
    assert row.outcome == f"seed {CHUNK + 3}: it broke"
    assert list(read_record(path).failed) == [1]
    assert run_fuzz("v4", "none", 5, mended, path).outcome == "clean"
    assert mended.asked == [range(5)]


def test_cases_are_recorded_one_by_one_and_not_run_again(tmp_path: Path, code: list[str]):
    path, ran = tmp_path / "stress.csv", []

    def case(name: str, passed: bool = True, minutes: int = 0) -> Case:
        def run(full: bool) -> Verdict:
            """Holds."""
            ran.append(name)
            return Verdict(f"{len(ran)}, as written", passed)

        return Case(name, run, minutes)

    a, b, c = case("N1 a"), case("N2 b", passed=False, minutes=2), case("N3 c")
    run_cases([a, b, c], True, path)
    assert list(read_record(path).case) == ["N1 a", "N2 b", "N3 c"]
    run_cases([a, b, c], True, path)
    assert ran == ["N1 a", "N3 c", "N2 b", "N2 b"], "what failed runs again, what passed does not"
    assert list(read_record(path).measured) == ["1, as written", "4, as written", "2, as written"]
    run_cases([a, c], True, None)
    assert ran[4:] == ["N1 a", "N3 c"], "without a file everything runs"
    code[0] = "b" * 40
    run_cases([a], True, path)
    assert ran[6:] == ["N1 a"]
    assert list(read_record(path).commit) == ["b" * 40]


def test_a_case_that_ends_the_process_leaves_those_before_it(tmp_path: Path, code: list[str]):
    def ends(full: bool) -> Verdict:
        """Never."""
        raise KeyboardInterrupt

    def holds(full: bool) -> Verdict:
        """Holds."""
        return Verdict("fine", True)

    path = tmp_path / "stress.csv"
    with pytest.raises(KeyboardInterrupt):
        run_cases([Case("N1 a", holds), Case("N2 b", ends)], True, path)
    assert list(read_record(path).case) == ["N1 a"]
