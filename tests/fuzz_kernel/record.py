"""fuzz.csv: how many seeds of the fuzz ran clean, per instruction set and sanitizers."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from tests.fuzz_kernel import FuzzReport
from tests.recorded import commit_with, same_code_with
from vlgs.bench.record import provenance, read_record, say, write_record

FOLDER = Path(__file__).parent
CHUNK = 500
"""Scenes between two writings of the file."""
CLEAN = "clean"
COMMANDS = "python -m tests.fuzz_kernel; python csrc/sanitize.py"


@dataclass(frozen=True)
class FuzzRow:
    """Seeds 0, 1, ... up to `scenes`."""

    isa: str
    sanitizers: str
    """What looked on: ``none``, or the names of sanitizers."""
    scenes: int
    finite: int
    refused: int
    """Scenes that ended in a named error."""
    failed: int
    outcome: str
    """``clean``, or the first failure."""
    seconds: float
    """Wall clock."""
    commit: str | None


def run_fuzz(
    isa: str,
    sanitizers: str,
    scenes: int,
    run: Callable[[range], FuzzReport],
    path: Path,
) -> FuzzRow:
    """Run the seeds from 0 on, in parts; the file's row of this instruction set and sanitizers is written after each.

    A clean row of the same code is continued where it ended; one of other code, or with a failure, is begun again. Stops after a
    part with a failure.

    Args:
        isa: Instruction set that `run` uses.
        sanitizers: Under which sanitizers it does.
        scenes: Seeds in all.
        run: Runs some seeds.
        path: Of the file.
    """
    header = provenance(None, command=COMMANDS)
    for each in ("isa", "commit", "seed"):  # a matter of the row
        del header[each]
    rows = [FuzzRow(**row) for row in _read(path)]
    mine = next((row for row in rows if (row.isa, row.sanitizers) == (isa, sanitizers)), None)
    others = [row for row in rows if row is not mine]
    here = commit_with(FOLDER)
    if mine is None or mine.outcome != CLEAN or not same_code_with(FOLDER, mine.commit, here):
        mine = FuzzRow(isa, sanitizers, 0, 0, 0, 0, CLEAN, 0.0, here)
    elif mine.scenes:
        say(f"{isa}, sanitizers {sanitizers}: {mine.scenes} scenes are there")
    while mine.scenes < scenes and mine.outcome == CLEAN:
        seeds = range(mine.scenes, min(mine.scenes + CHUNK, scenes))
        start = time.perf_counter()
        report = run(seeds)
        mine = replace(
            mine,
            scenes=seeds.stop,
            finite=mine.finite + report.finite,
            refused=mine.refused + report.refused,
            failed=mine.failed + len(report.failures),
            outcome=next((f"seed {s}: {what}" for s, what in report.failures.items()), CLEAN),
            seconds=mine.seconds + time.perf_counter() - start,
        )
        rows = sorted([*others, mine], key=lambda row: (row.sanitizers, row.isa))
        write_record(path, rows, header)
        say(f"{isa}, sanitizers {sanitizers}: {mine.scenes} scenes, {mine.outcome}")
    return mine


def _read(path: Path) -> list[dict]:
    if not path.is_file():
        return []
    table = read_record(path)
    return table.astype(object).where(pd.notna(table), None).to_dict("records")  # pyright: ignore[reportReturnType]
