"""Every stress case at a small size; `python -m tests.stress` runs the same list at 10^4 to 10^6."""

from pathlib import Path

import pytest

from tests.stress import CASES, __main__, bits
from tests.stress.__main__ import main
from tests.stress.case import CannotRunError, Case, Verdict
from tests.stress.record import FAILED, NOT_RUN, run_cases, show_table
from vlgs.bench.record import read_record

SLOW = (
    "N2 poison",
    "N1 poisoned gradients",
    "N1 hostile training",
    "N12 threads and repeats, v4",
    "N12 threads and repeats, v3",
    "N12 threads and repeats, base",
)
"""Trainings, of 5 seconds and more, or in a process of their own."""


def marked(case: Case):
    return pytest.param(case, id=case.name, marks=pytest.mark.slow if case.name in SLOW else ())


@pytest.mark.parametrize("case", [marked(case) for case in CASES])
def test_case(case: Case):
    try:
        verdict = case.run(False)
    except CannotRunError as reason:
        pytest.skip(str(reason))
    assert verdict.passed, f"{case.criterion}\nmeasured: {verdict.measured}"


def test_every_known_failure_has_a_case_and_every_case_a_criterion():
    numbers = {int(case.name[1:].split()[0]) for case in CASES}
    assert numbers == set(range(1, 20))
    assert all(case.criterion for case in CASES)


def test_a_failure_and_an_exception_are_failures(tmp_path: Path):
    def fails(full: bool) -> Verdict:
        """Never."""
        return Verdict("7 (<= 3)", False)

    def breaks(full: bool) -> Verdict:
        """Never."""
        raise RuntimeError("no")

    path = tmp_path / "out" / "stress.csv"
    rows = run_cases([Case("N1 a", fails), Case("N2 b", breaks)], False, path)
    assert [row.outcome for row in rows] == [FAILED, FAILED]
    assert show_table(rows).row_count == 2
    assert list(read_record(path).measured) == ["7 (<= 3)", "RuntimeError: no"]


def test_what_the_machine_cannot_run_has_neither_passed_nor_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(bits.machine, "instruction_sets", lambda: ["base"])
    cases = tuple(case for case in CASES if case.name.endswith((", v4", ", v3")))
    monkeypatch.setattr(__main__, "CASES", cases)
    assert main(["--out", str(tmp_path)]) == 0
    assert list(read_record(tmp_path / "stress.csv").outcome) == [NOT_RUN, NOT_RUN]
    text = " ".join(capsys.readouterr().out.split())
    assert "N12 threads and repeats, v3: not run, this machine and this build have base" in text
    assert "not run on this machine: 2 of 2 (N12 threads and repeats, v4; N12" in text

    broken = Case("N1 a", lambda full: Verdict("7 (<= 3)", False))
    monkeypatch.setattr(__main__, "CASES", (*cases, broken))
    assert main(["--out", str(tmp_path)]) == 1
