"""Numerical truth: inputs on which systems of this kind are known to fail, each with the criterion it must meet.

One list of cases: `python -m vlgs.bench stress` runs them at full size (10^4 to 10^6), the tests run them small. The numbers
N1 to N19 are those of the project's list of known failures.
"""

import csv
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.table import Table

from vlgs import _csrc
from vlgs.bench.stress.bits import BITS
from vlgs.bench.stress.case import Case, Verdict
from vlgs.bench.stress.functions import FUNCTIONS
from vlgs.bench.stress.hostile import HOSTILE
from vlgs.bench.stress.order import ORDER
from vlgs.bench.stress.training import TRAINING
from vlgs.report.provenance import commit, machine

CASES: tuple[Case, ...] = tuple(
    sorted((*HOSTILE, *ORDER, *FUNCTIONS, *TRAINING, *BITS), key=lambda c: int(c.name[1:].split()[0]))
)  # fmt: skip


def run_cases(cases: Sequence[Case], full: bool) -> Iterator[tuple[Case, Verdict, float]]:
    """Every case with its verdict and the seconds it took; an exception is a failure."""
    for case in cases:
        start = time.perf_counter()
        try:
            verdict = case.run(full)
        except Exception as error:
            verdict = Verdict(f"{type(error).__name__}: {error}", False)
        yield case, verdict, time.perf_counter() - start


def show_table(results: Sequence[tuple[Case, Verdict, float]]) -> Table:
    """Case, criterion, what was measured, whether it passed."""
    table = Table(title=f"vlgs stress, {_csrc.isa()}", show_lines=True)
    for name in ("case", "criterion", "measured", "passed"):
        table.add_column(name)
    for case, verdict, _ in results:
        table.add_row(
            case.name,
            case.criterion,
            verdict.measured,
            "yes" if verdict.passed else "[red]NO[/red]",
        )
    return table


def write_csv(results: Sequence[tuple[Case, Verdict, float]], path: Path) -> None:
    """One line per case; comments say which machine and commit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        file.writelines(f"# {key}: {value}\n" for key, value in machine().items())
        file.write(f"# commit: {commit()}\n# isa: {_csrc.isa()}\n")
        writer = csv.writer(file)
        writer.writerow(["case", "criterion", "measured", "passed", "seconds"])
        for case, verdict, seconds in results:
            row = [case.name, case.criterion, verdict.measured, verdict.passed, f"{seconds:.1f}"]
            writer.writerow(row)
