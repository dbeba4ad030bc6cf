"""Command line of the benchmarks."""

import argparse
import sys
from pathlib import Path

from rich.console import Console

from vlgs.bench.kernel import SIZES, measure_kernel, show_table, write_csv
from vlgs.bench.overhead import measure_overhead


def main() -> None:
    """Time what is asked for and print it."""
    parser = argparse.ArgumentParser(prog="python -m vlgs.bench", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    kernel = commands.add_parser("kernel", help="forward and backward of the rasterizer")
    kernel.add_argument("--sizes", type=int, nargs="+", default=range(len(SIZES)), metavar="ROW")
    kernel.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    kernel.add_argument("--channels", type=int, nargs="+", default=[3], help="of language")
    kernel.add_argument("--repeats", type=int, default=9)
    kernel.add_argument(
        "--out", type=Path, nargs="?", const=Path("results/bench/kernel.csv"), help="write CSV"
    )
    overhead = commands.add_parser("overhead", help="what the Trainer adds to an iteration")
    overhead.add_argument("--iterations", type=int, default=300)
    stress = commands.add_parser("stress", help="hostile input: case, criterion, measured, passed")
    stress.add_argument("--only", nargs="+", default=[], metavar="CASE", help="names or parts")
    stress.add_argument("--small", action="store_true", help="the sizes of the tests")
    stress.add_argument("--out", type=Path, default=Path("results/bench/stress.csv"))
    fuzz = commands.add_parser("fuzz", help="random hostile scenes through the rasterizer")
    fuzz.add_argument("--scenes", type=int, default=10_000)
    fuzz.add_argument("--first", type=int, default=0, help="first seed")
    args = parser.parse_args()
    if args.command == "stress":
        sys.exit(_stress(args))
    if args.command == "fuzz":
        from vlgs.bench.fuzz import fuzz as run_fuzz

        report = run_fuzz(range(args.first, args.first + args.scenes))
        print(report)
        sys.exit(bool(report.failures))
    if args.command == "overhead":
        cost = measure_overhead(args.iterations)
        Console().print(f"step {cost.step:.2f} ms, around it {cost.around:.2f} ms (medians)")
        return
    sizes = [SIZES[i] for i in args.sizes]
    timings = measure_kernel(sizes, args.threads, args.channels, args.repeats)
    console = Console()
    console.print(show_table(timings), width=max(console.width, 110))
    if args.out:
        write_csv(timings, args.out)


def _stress(args: argparse.Namespace) -> int:
    """Run the cases, print each as it ends and the table last; 1 if one failed."""
    from vlgs.bench import stress

    cases = [c for c in stress.CASES if not args.only or any(part in c.name for part in args.only)]
    if not cases:
        raise SystemExit(f"stress: --only must match a case, got {args.only}")
    console, results = Console(), []
    for result in stress.run_cases(cases, full=not args.small):
        results.append(result)
        case, verdict, seconds = result
        console.print(f"{case.name}: {'passed' if verdict.passed else 'FAILED'} in {seconds:.1f} s")
    console.print(stress.show_table(results), width=max(console.width, 140))
    if not args.only and not args.small:  # a part of the cases never replaces the file of all
        stress.write_csv(results, args.out)
    return int(any(not verdict.passed for _, verdict, _ in results))


if __name__ == "__main__":
    main()
