"""`python -m tests.stress [--only CASE ...]`: hostile input, case by case, at full size: criterion, measured, passed."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from tests.stress import CASES
from tests.stress.record import FAILED, run_cases, show_table


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases that have not passed on this code; returns the exit status, 1 where one failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.stress", description=__doc__)
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="CASE", help="names or parts: run, not recorded"
    )
    parser.add_argument("--quick", action="store_true", help="small scenes: does it run?")
    parser.add_argument(
        "--out", type=Path, help="default: results/bench, or its quick/ with --quick"
    )
    args = parser.parse_args(arguments)
    cases = [c for c in CASES if not args.only or any(part in c.name for part in args.only)]
    if not cases:
        parser.error(f"--only must match a case, got {' '.join(args.only)}")
    folder = args.out or Path("results/bench/quick" if args.quick else "results/bench")
    rows = run_cases(cases, not args.quick, None if args.only else folder / "stress.csv")
    console = Console()
    console.print(show_table(rows), width=max(console.width, 140))
    return int(any(row.outcome == FAILED for row in rows))


if __name__ == "__main__":
    sys.exit(main())
