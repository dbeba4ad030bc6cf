"""Command line of the benchmarks."""

import argparse
from pathlib import Path

import torch
from rich.console import Console

from vlgs.bench.iteration import SIZES as ITERATIONS
from vlgs.bench.iteration import measure_iteration, show_iterations
from vlgs.bench.kernel import SIZES, measure_kernel, show_table, write_csv
from vlgs.bench.overhead import measure_overhead
from vlgs.bench.protocols import measure_protocols, show_protocols


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
    protocols = commands.add_parser("protocols", help="scores of many queries, without rendering")
    protocols.add_argument("--queries", type=int, default=300)
    protocols.add_argument("--levels", type=int, default=3, help="mask levels")
    protocols.add_argument("--size", type=int, nargs=2, default=(986, 728), metavar=("W", "H"))
    iteration = commands.add_parser("iteration", help="parts of a training iteration by CPU time")
    iteration.add_argument("--sizes", type=int, nargs="+", default=range(len(ITERATIONS)))
    iteration.add_argument("--iterations", type=int, default=20)
    iteration.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    if args.command == "iteration":
        torch.set_num_threads(args.threads)
        measured = [(ITERATIONS[i], measure_iteration(ITERATIONS[i], args.iterations)) for i in args.sizes]
        Console().print(show_iterations(measured))
        return
    if args.command == "protocols":
        costs = measure_protocols(args.queries, args.levels, *args.size)
        Console().print(show_protocols(costs))
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
