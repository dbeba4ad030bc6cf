"""stress.csv: what each case measured, written case by case."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rich.table import Table

from tests.recorded import commit_with, same_code_with
from tests.stress.case import CannotRunError, Case
from vlgs.bench.record import provenance, read_record, say, write_record
from vlgs.ops.machine import instruction_set

FOLDER = Path(__file__).parent
PASSED, FAILED, NOT_RUN = "passed", "FAILED", "not run"


@dataclass(frozen=True)
class StressRow:
    """One case."""

    case: str
    criterion: str
    measured: str
    outcome: str
    """`PASSED`, `FAILED`, or `NOT_RUN` where this machine cannot run it."""
    seconds: float
    """Wall clock."""
    cpu_seconds: float
    """Of all threads and of the processes that the case started."""
    isa: str
    """Instruction set; N12 runs on all of them."""
    commit: str | None


def run_case(case: Case, full: bool) -> StressRow:
    """Run one; an exception is a failure, unless it says that the machine cannot run the case."""
    wall, cpu = time.perf_counter(), sum(os.times()[:4])
    try:
        verdict = case.run(full)
        measured, outcome = verdict.measured, PASSED if verdict.passed else FAILED
    except CannotRunError as error:
        measured, outcome = str(error), NOT_RUN
    except Exception as error:
        measured, outcome = f"{type(error).__name__}: {error}", FAILED
    return StressRow(
        case.name, case.criterion, measured, outcome,
        round(time.perf_counter() - wall, 1), round(sum(os.times()[:4]) - cpu, 1), instruction_set(), commit_with(FOLDER),
    )  # fmt: skip


def run_cases(cases: Sequence[Case], full: bool, path: Path | None) -> list[StressRow]:
    """Run those that the file does not have as passed by the same code and instruction set, and write it after each.

    The long ones run last, so that a run that is stopped leaves the most.

    Args:
        cases: In the order of the file.
        full: Whether at full size.
        path: Of the file; None runs all and writes nothing.
    """
    header = provenance(None, program="tests.stress")
    for each in ("isa", "commit", "seed"):  # a matter of the row, and of the cases
        del header[each]
    known = _passed(path, commit_with(FOLDER), instruction_set())
    done = {case.name: known[case.name] for case in cases if case.name in known}
    for case in sorted(cases, key=lambda c: c.minutes):
        if case.name in done:
            say(f"{case.name}: is there")
            continue
        row = done[case.name] = run_case(case, full)
        how = f", {row.measured}" if row.outcome == NOT_RUN else f" in {row.seconds:.1f} s"
        say(f"{row.case}: {row.outcome}{how}")
        if path is not None:
            # Rows of cases yet to come stay out: they are of other code.
            write_record(path, [done[c.name] for c in cases if c.name in done], header)
    return [done[case.name] for case in cases]


def _passed(path: Path | None, here: str | None, isa: str) -> dict[str, StressRow]:
    """Rows of a file that need not be run again, by case."""
    if path is None or not path.is_file():
        return {}
    table = read_record(path)
    if list(table) != [field.name for field in fields(StressRow)]:  # of an older version
        return {}
    times = ("seconds", "cpu_seconds")  # whole ones come as int
    records: list[dict[str, Any]] = [
        {str(key): float(value) if key in times else value for key, value in record.items()}
        for record in table.to_dict("records")
    ]
    rows = [StressRow(**record) for record in records]
    return {
        row.case: row
        for row in rows
        if row.outcome == PASSED
        and row.isa == isa
        and isinstance(row.commit, str)
        and same_code_with(FOLDER, row.commit, here)
    }


def show_table(rows: Sequence[StressRow]) -> Table:
    """Case, criterion, what was measured, how it came out; and how many were not run."""
    table = Table(title=f"vlgs stress, {instruction_set()}", show_lines=True)
    for name in ("case", "criterion", "measured", "outcome"):
        table.add_column(name)
    for row in rows:
        color = {PASSED: "default", FAILED: "red", NOT_RUN: "yellow"}[row.outcome]
        table.add_row(row.case, row.criterion, row.measured, f"[{color}]{row.outcome}[/]")
    missing = [row.case for row in rows if row.outcome == NOT_RUN]
    if missing:
        table.caption = (
            f"not run on this machine: {len(missing)} of {len(rows)} ({'; '.join(missing)})"
        )
    return table
