"""The table "tried, right" as a file: a row per family, under comments that say who measured."""

import os
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

from tests.fuzz.judge import AttackOutcome
from vlgs.bench.record import read_record, write_record
from vlgs.report.provenance import PACKAGE, commit, machine

CODE = ("vlgs", "csrc", "conf")
COMMANDS = "python -m tests.fuzz FAMILY --count COUNT --seed SEED --write FILE"


@dataclass(frozen=True)
class FamilyRow:
    """What became of the attacks of one family."""

    family: str
    count: int
    """As asked for; a family with a fixed list has its own."""
    seed: int
    commit: str
    """Of the code that was attacked."""
    tried: int = 0
    right: int = 0
    whole: bool = False
    """Whether all of them were tried; one that is not whole is gone on with by the same command on the same code."""
    slowest_cpu_s: float = 0.0
    largest_mb: float = 0.0
    """Growth of the peak memory of a process."""
    wall_s: float = 0.0

    def plus(self, outcome: AttackOutcome, wall: float) -> "FamilyRow":
        """With one more attack."""
        return replace(
            self,
            tried=self.tried + 1,
            right=self.right + outcome.right,
            slowest_cpu_s=max(self.slowest_cpu_s, round(outcome.seconds, 1)),
            largest_mb=max(self.largest_mb, round(outcome.megabytes)),
            wall_s=round(self.wall_s + wall, 2),
        )


def attacked() -> str:
    """The last commit that changed what is attacked: of two that differ in tests and documents alone, the rows are those of one."""
    found = subprocess.run(
        ["git", "log", "-1", "--format=%H", "--", *CODE],
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    return f"{found}+dirty" if "+dirty" in str(commit()) else found


def begun(path: Path | None, fresh: FamilyRow) -> FamilyRow:
    """The row of an interrupted run of the same attacks on the same code, so far without a fault; else `fresh`."""
    for row in _read(path) if path else ():
        same = replace(fresh, tried=row.tried, right=row.tried) == replace(
            row, slowest_cpu_s=0.0, largest_mb=0.0, wall_s=0.0
        )
        if same and "+dirty" not in row.commit:
            return row
    return fresh


def write_row(path: Path, row: FamilyRow) -> None:
    """Add a row, or put it in the place of its family's; the rows of other families stay."""
    rows = [*(other for other in _read(path) if other.family != row.family), row]
    load = f"{os.getloadavg()[0]:.2f} (one-minute average at the end)"
    header = {"command": COMMANDS, **machine(), "load": load}
    write_record(path, sorted(rows, key=lambda line: line.family), header)


def _read(path: Path) -> list[FamilyRow]:
    lines = read_record(path).to_dict("records") if path.is_file() else []
    return [FamilyRow(**{str(key): value for key, value in line.items()}) for line in lines]
