"""The table "tried, right" as a file: a row per family, under comments that say who measured."""

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

from vlgs.bench.sheet import read_sheet, write_sheet
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
    tried: int
    right: int
    slowest_cpu_s: float
    largest_mb: float
    """Growth of the peak memory of a process."""
    wall_s: float
    commit: str
    """Of the code that was attacked."""


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


def write_row(path: Path, row: FamilyRow) -> None:
    """Add a row, or put it in the place of its family's; the rows of other families stay."""
    found = read_sheet(path).to_dict("records") if path.is_file() else []
    rows = [FamilyRow(**{str(k): v for k, v in line.items()}) for line in found]
    rows = [*(other for other in rows if other.family != row.family), row]
    header = {
        "command": COMMANDS,
        **machine(),
        "load": f"{os.getloadavg()[0]:.2f} (one-minute average at the end)",
    }
    write_sheet(path, sorted(rows, key=lambda line: line.family), header)
