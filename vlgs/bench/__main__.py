"""Command line of the benchmarks."""

import argparse
from pathlib import Path

import torch
from rich.console import Console

from vlgs.bench.iteration import SIZES as ITERATIONS
from vlgs.bench.iteration import measure_iteration, show_iterations
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
    iteration = commands.add_parser("iteration", help="parts of a training iteration by CPU time")
    iteration.add_argument("--sizes", type=int, nargs="+", default=range(len(ITERATIONS)))
    iteration.add_argument("--iterations", type=int, default=20)
    iteration.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    if args.command == "iteration":
        torch.set_num_threads(args.threads)
        sizes = [ITERATIONS[i] for i in args.sizes]
        measured = [(size, measure_iteration(size, args.iterations)) for size in sizes]
        Console().print(show_iterations(measured))
        return
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


if __name__ == "__main__":
    main()
