"""`python -m tests.fuzz [FAMILY...] [--count N] [--seed S] [--only NUMBER] [--write FILE]`: the table "tried, right"."""

import argparse
import importlib
import pkgutil
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from tests import fuzz
from tests.fuzz._table import FamilyRow, attacked, begun, write_row
from tests.fuzz.judge import AttackOutcome, run_attack, scratch
from vlgs.text import screen

SAVED_EVERY = 30
"""Seconds between two writings of a family's row."""


def families() -> list[str]:
    """Names of the families, each a module of this folder."""
    names = (module.name for module in pkgutil.iter_modules(fuzz.__path__))
    helpers = ("judge", "commands")
    return sorted(
        name for name in names if name not in helpers and not name.startswith(("_", "test_"))
    )


def run_family(
    name: str, seed: int, count: int, every: int = 1, only: int | None = None, first: int = 0
) -> Iterator[tuple[int, AttackOutcome]]:
    """Numbers and outcomes of one family: of each `every`-th attack from `first` on, or of one alone."""
    folder = scratch()
    try:
        attacks = importlib.import_module(f"tests.fuzz.{name}").attacks(folder, seed, count)
        for number, attack in enumerate(attacks):
            if (number % every == 0 and number >= first) if only is None else number == only:
                yield number, run_attack(attack)
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
        "--write",
        type=Path,
        help="csv with a row per family; those of other families stay, and one that was interrupted is gone on with",
    )
    options = parser.parse_args()
    if options.write and (options.every > 1 or options.only is not None):
        parser.error("--write is for all attacks of a family, without --every and --only")
    wrong, code = 0, attacked()  # before the attacks: it may change meanwhile
    for name in options.family or families():
        fresh = FamilyRow(name, options.count, options.seed, code)
        row = begun(options.write, fresh)
        bad, saved = [], time.monotonic()
        started = time.perf_counter()
        for number, outcome in run_family(
            name, options.seed, options.count, options.every, options.only, row.tried
        ):
            now = time.perf_counter()
            row, started = row.plus(outcome, now - started), now
            bad += [] if outcome.right else [(number, outcome)]
            if options.write and time.monotonic() - saved > SAVED_EVERY:
                write_row(options.write, row)
                saved = time.monotonic()
        wrong += len(bad)
        if options.write:
            write_row(options.write, replace(row, whole=True))
        print(
            f"{name:<16} tried {row.tried:>5}  right {row.right:>5}  {row.slowest_cpu_s:.1f} s CPU, {row.largest_mb:.0f} MB at most"
        )
        for number, outcome in bad:
            print(screen(f"  --only {number}  {outcome.name}: {outcome.said}"))
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
