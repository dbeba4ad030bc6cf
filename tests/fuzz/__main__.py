"""`python -m tests.fuzz [FAMILY...] [--count N] [--seed S] [--only NUMBER] [--write FILE]`: the table "tried, right"."""

import argparse
import importlib
import pkgutil
import shutil
import sys
import time
from pathlib import Path

from tests import fuzz
from tests.fuzz._table import FamilyRow, attacked, write_row
from tests.fuzz.judge import Outcome, run_attack, scratch
from vlgs.text import screen


def families() -> list[str]:
    """Names of the families, each a module of this folder."""
    names = (module.name for module in pkgutil.iter_modules(fuzz.__path__))
    helpers = ("judge", "commands")
    return sorted(
        name for name in names if name not in helpers and not name.startswith(("_", "test_"))
    )


def run_family(
    name: str, seed: int, count: int, every: int = 1, only: int | None = None
) -> list[Outcome]:
    """Outcomes of one family: of each `every`-th attack, or of one alone."""
    folder = scratch()
    try:
        attacks = importlib.import_module(f"tests.fuzz.{name}").attacks(folder, seed, count)
        return [
            run_attack(attack)
            for number, attack in enumerate(attacks)
            if (number % every == 0 if only is None else number == only)
        ]
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    """Run, print, exit with 1 where something was not right."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=fuzz.__doc__)
    parser.add_argument("family", nargs="*", choices=[[], *families()], help="all without one")
    parser.add_argument(
        "--count",
        type=int,
        default=100,
        help="attacks per family (a family with a fixed list has its own)",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every", type=int, default=1, help="try each so many-th attack alone")
    parser.add_argument("--only", type=int, help="number of one attack to run again")
    parser.add_argument(
        "--write", type=Path, help="csv with a row per family; those of other families stay"
    )
    options = parser.parse_args()
    wrong, code = 0, attacked()  # before the attacks: it may change meanwhile
    for name in options.family or families():
        started = time.perf_counter()
        outcomes = run_family(name, options.seed, options.count, options.every, options.only)
        bad = [(number, o) for number, o in enumerate(outcomes) if not o.right]
        wrong += len(bad)
        slowest = max((o.seconds for o in outcomes), default=0.0)
        largest = max((o.megabytes for o in outcomes), default=0.0)
        wall = time.perf_counter() - started
        if options.write:
            figures = round(slowest, 1), round(largest), round(wall)
            tried = len(outcomes), len(outcomes) - len(bad)
            row = FamilyRow(name, options.count, options.seed, *tried, *figures, code)
            write_row(options.write, row)
        print(
            f"{name:<16} tried {len(outcomes):>5}  right {len(outcomes) - len(bad):>5}  {slowest:.1f} s CPU, {largest:.0f} MB at most"
        )
        for number, outcome in bad:
            print(screen(f"  --only {number}  {outcome.name}: {outcome.said}"))
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
