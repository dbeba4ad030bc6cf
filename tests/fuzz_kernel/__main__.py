"""`python -m tests.fuzz_kernel [--scenes N] [--first SEED]`: hostile scenes through the kernels, recorded in fuzz.csv."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.fuzz_kernel import fuzz
from tests.fuzz_kernel.record import CLEAN, run_fuzz
from vlgs.ops.machine import instruction_set


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the seeds; returns the exit status, 1 where a scene was answered wrongly."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz_kernel", description=fuzz.__doc__)
    parser.add_argument("--scenes", type=int, default=10_000, help="in all, with those recorded")
    parser.add_argument("--first", type=int, help="first seed; default: 0, and record")
    parser.add_argument("--out", type=Path, default=Path("results/bench"), help="of fuzz.csv")
    args = parser.parse_args(arguments)
    if args.first is not None:
        report = fuzz(range(args.first, args.first + args.scenes))
        print(report)
        return int(bool(report.failures))
    row = run_fuzz(instruction_set(), "none", args.scenes, fuzz, args.out / "fuzz.csv")
    return int(row.outcome != CLEAN)


if __name__ == "__main__":
    sys.exit(main())
