"""Run time against error: `python -m vlgs.bench <what>`; results/bench/README.md says what each leaves behind."""

import argparse
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from pathlib import Path

# Modules are imported where they are used: child processes import this file again and need little of it.

Runner = Callable[[Namespace], int]
"""Does a subcommand; returns the exit status."""


def kernel(parser: ArgumentParser) -> Runner:
    """Forward and backward of the rasterizer: sizes, channels, threads, instruction sets."""
    parser.add_argument("--sizes", type=int, nargs="*", metavar="ROW", help="rows of the workload")
    parser.add_argument("--channels", type=int, nargs="+", default=[3, 16, 512], help="of language")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--isa", nargs="+", default=["v4", "v3", "base"])
    parser.add_argument("--repeats", type=int, default=9)

    def run(args: Namespace) -> int:
        from vlgs.bench.kernel import DENSE_SIZES, SIZES, Size, run_kernel

        sizes = [SIZES[i] for i in (range(len(SIZES)) if args.sizes is None else args.sizes)]
        dense, channels, repeats = DENSE_SIZES, args.channels, args.repeats
        if args.quick:
            sizes, dense, channels, repeats = [Size(500, 64, 48)], [Size(100, 32, 24)], [3, 16], 3
        run_kernel(sizes, dense, channels, args.threads, args.isa, repeats, args.out, args.seed)
        return 0

    return run


def error(parser: ArgumentParser) -> Runner:
    """Presets, switches and precisions: time, memory and error against float64; 1 if a promise is broken."""
    parser.add_argument(
        "--run", type=Path, help="a run folder; default: train the procedural scene"
    )
    parser.add_argument("--no-trained", action="store_true", help="the workload alone")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=9)

    def run(args: Namespace) -> int:
        from vlgs.bench.error import make_scenes, run_error
        from vlgs.bench.presets import load_run, train_a_little, train_or_load
        from vlgs.bench.train import QUICK

        sizes = [(400, 64, 48)] if args.quick else [(50_000, 320, 240), (200_000, 640, 480)]
        trained = None
        if args.run is not None:
            trained = load_run(args.run)
        elif not args.no_trained and not args.quick:
            trained = train_or_load([f"seed={args.seed}"], Path("results"))
        stepping = trained
        if args.quick and not args.no_trained and trained is None:
            stepping = train_a_little([*QUICK, "head.cache_dir=null", f"seed={args.seed}"])
        scenes = make_scenes(sizes, trained, args.seed)
        repeats = 3 if args.quick else args.repeats
        broken = run_error(scenes, trained, args.threads, repeats, args.out, args.seed, stepping)
        for check in broken:
            print(
                f"error: {check.scene}: {check.promise} must be at most {check.bound:.2e}, got {check.measured:.2e}",
                file=sys.stderr,
            )
        return 1 if broken else 0

    return run


def pareto(parser: ArgumentParser) -> Runner:
    """Run time against error in one picture, from error.csv."""

    def run(args: Namespace) -> int:
        from vlgs.bench.pareto import run_pareto

        run_pareto(args.out)
        return 0

    return run


def growth(parser: ArgumentParser) -> Runner:
    """Time against Gaussians, pixels, channels and threads."""
    parser.add_argument("--repeats", type=int, default=7)

    def run(args: Namespace) -> int:
        from vlgs.bench.growth import make_points, run_growth

        repeats = 3 if args.quick else args.repeats
        run_growth(make_points(args.quick), repeats, args.out, args.seed)
        return 0

    return run


def train(parser: ArgumentParser) -> Runner:
    """Seconds to a PSNR and an mIoU, for presets and schedules; finished curves are not trained again."""
    parser.add_argument("--recipes", nargs="+", help="labels of vlgs/bench/train.py; default: all")
    parser.add_argument("--root", type=Path, help="a scene of photographs (data=colmap data.root=)")
    parser.add_argument("--resize", type=float, default=0.5, help="of the photographs")
    parser.add_argument(
        "--override", nargs="+", default=[], metavar="KEY=VALUE",
        help="of the photographs, e.g. data.features=FOLDER query=vocab_softmax",
    )  # fmt: skip
    parser.add_argument("--no-synthetic", action="store_true", help="the photographs alone")
    parser.add_argument(
        "--large", action="store_true", help="the procedural scene with 300 views of 986x728"
    )
    parser.add_argument("--seeds", type=int, nargs="+", help="of the training; default: --seed")
    parser.add_argument("--points", type=int, default=8, help="evaluations per curve")
    parser.add_argument("--train-threads", type=int, default=2)
    parser.add_argument("--psnr", type=float, help="target in dB; default: that of default - 1")
    parser.add_argument("--miou", type=float, help="target; default: that of default - 0.02")

    def run(args: Namespace) -> int:
        from vlgs.bench.train import RECIPES, run_train, scene_overrides

        labels = args.recipes or (["default", "neither"] if args.quick else list(RECIPES))
        unknown = sorted(set(labels) - set(RECIPES))
        if unknown:
            known = "; ".join(RECIPES)  # some names have commas
            raise ValueError(f"bench: recipe must be one of {known}; got {unknown[0]}")
        scenes = scene_overrides(
            args.root, args.resize, args.quick, not args.no_synthetic, args.override, args.large
        )
        points = 2 if args.quick else args.points
        targets = (args.psnr, args.miou)
        seeds = args.seeds or [args.seed]
        run_train(scenes, labels, args.out, points, args.train_threads, seeds, targets)
        return 0

    return run


def unseen(parser: ArgumentParser) -> Runner:
    """Views between, beyond and above the training views, few views, skies, plain walls; what has a row is not trained again."""
    parser.add_argument("--scenes", nargs="+", help="default: all of vlgs/bench/unseen.py")
    parser.add_argument("--views", type=int, nargs="+", default=[12, 20, 40], help="to train on")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--root", type=Path, help="folder of the scenes of photographs")
    parser.add_argument("--resize", type=float, default=0.5, help="of the photographs")
    parser.add_argument("--splits", nargs="+", help="of them; default: all of vlgs/bench/unseen.py")
    parser.add_argument("--recipe", default="default", help="a name for what --override changes")
    parser.add_argument("--override", nargs="+", default=[], metavar="KEY=VALUE")
    parser.add_argument("--beside", nargs="+", action="append", default=[], metavar=("NAME", "KEY=VALUE"), help="another recipe, trained in turns with the first; may be given again")  # fmt: skip
    parser.add_argument("--train-threads", type=int, default=1)

    def run(args: Namespace) -> int:
        from vlgs.bench import unseen as yardstick

        scenes = args.scenes or [*yardstick.PROCEDURAL, *yardstick.PHOTOGRAPHS]
        views, seeds = ([4], [args.seed]) if args.quick else (args.views, args.seeds)
        splits = args.splits or yardstick.SPLITS
        tasks = yardstick.make_tasks(scenes, views, args.root, args.resize, args.quick, splits)
        recipes = yardstick.recipes_of(args.recipe, args.override, args.beside)
        yardstick.run_unseen(tasks, recipes, seeds, args.out, args.train_threads)
        return 0

    return run


def threads(parser: ArgumentParser) -> Runner:
    """The rasterizer by which of torch and vlgs is imported first, idle and beside busy processes."""
    parser.add_argument(
        "--size", type=int, nargs=3, default=(10_000, 320, 240), metavar=("N", "W", "H")
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=40)

    def run(args: Namespace) -> int:
        from rich.console import Console

        from vlgs.bench.threads import measure_threads, show_threads

        (n, width, height), repeats = (
            ((500, 64, 48), 2) if args.quick else (args.size, args.repeats)
        )
        Console().print(show_threads(measure_threads(n, width, height, args.threads, repeats)))
        return 0

    return run


def overhead(parser: ArgumentParser) -> Runner:
    """What the Trainer adds to an iteration."""
    parser.add_argument("--iterations", type=int, default=300)

    def run(args: Namespace) -> int:
        from vlgs.bench.overhead import measure_overhead
        from vlgs.bench.record import say

        cost = measure_overhead(3 if args.quick else args.iterations)
        say(f"step {cost.step:.2f} ms, around it {cost.around:.2f} ms (medians)")
        return 0

    return run


def seams(parser: ArgumentParser) -> Runner:
    """What tables of attributes, objectives and the choice of a device add to a step."""
    parser.add_argument("--turns", type=int, default=20)

    def run(args: Namespace) -> int:
        from vlgs.bench.record import say
        from vlgs.bench.seams import measure_seams

        cost = measure_seams(2 if args.quick else args.turns)
        say(f"step {cost.step:.2f} ms, of which seams {cost.seams:.3f} ms, {cost.share:.2%} (CPU)")
        return 0

    return run


def iteration(parser: ArgumentParser) -> Runner:
    """Parts of a training iteration by CPU time; fusion and Adam alone, by threads."""
    parser.add_argument("--sizes", type=int, nargs="+", help="rows of vlgs/bench/iteration.py")
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--threads", type=int, default=2)

    def run(args: Namespace) -> int:
        import torch
        from rich.console import Console

        from vlgs.bench.alone import measure_alone, show_alone
        from vlgs.bench.iteration import SIZES, measure_iteration, show_iterations

        gaussians, repeats = (500, 2) if args.quick else (100_000, 3 * args.iterations)
        alone = measure_alone(gaussians, (1, 2), repeats, args.seed)
        Console().print(show_alone(gaussians, alone))
        torch.set_num_threads(args.threads)
        chosen = [0] if args.quick else args.sizes or range(len(SIZES))
        count = 3 if args.quick else args.iterations
        measured = [(SIZES[i], measure_iteration(SIZES[i], count)) for i in chosen]
        Console().print(show_iterations(measured))
        return 0

    return run


def reading(parser: ArgumentParser) -> Runner:
    """From the command to the first training step on many photographs: time and peak memory."""
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--size", type=int, nargs=2, default=(1152, 868), metavar=("W", "H"))

    def run(args: Namespace) -> int:
        from vlgs.bench.reading import run_reading

        images, size = (6, (64, 48)) if args.quick else (args.images, tuple(args.size))
        run_reading(images, size, args.out, args.seed)
        return 0

    return run


def protocols(parser: ArgumentParser) -> Runner:
    """Scores of many queries, without rendering."""
    parser.add_argument("--queries", type=int, default=300)
    parser.add_argument("--levels", type=int, default=3, help="mask levels")
    parser.add_argument("--size", type=int, nargs=2, default=(1152, 868), metavar=("W", "H"))
    parser.add_argument("--threads", type=int, default=2)

    def run(args: Namespace) -> int:
        from vlgs.bench.protocols import run_protocols

        queries, size = (2, (64, 48)) if args.quick else (args.queries, tuple(args.size))
        run_protocols(queries, args.levels, size, args.threads, args.out, args.seed)
        return 0

    return run


def startup(parser: ArgumentParser) -> Runner:
    """What a run costs beside its training, part by part; a small sweep from a warm parent and without one."""
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--no-sweep", action="store_true", help="single runs alone")

    def run(args: Namespace) -> int:
        from vlgs.bench.startup import run_startup

        repeats = 1 if args.quick else args.repeats
        run_startup(args.quick, repeats, not args.no_sweep, args.out, args.seed)
        return 0

    return run


def query(parser: ArgumentParser) -> Runner:
    """An answer to a word beside its two renders: decoded, folded, tables of several sizes, and their errors."""
    parser.add_argument(
        "--run", type=Path, help="a run folder; default: train the procedural scene"
    )
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=5)

    def run(args: Namespace) -> int:
        from vlgs.bench.presets import load_run, train_a_little, train_or_load
        from vlgs.bench.query import LARGE, run_query
        from vlgs.bench.train import QUICK

        if args.run is not None:
            trained = load_run(args.run)
        elif args.quick:
            trained = train_a_little([*QUICK, "head.cache_dir=null", f"seed={args.seed}"])
        else:
            trained = train_or_load([f"seed={args.seed}"], Path("results"))
        large, repeats = ((300, 40, 30), 2) if args.quick else (LARGE, args.repeats)
        run_query(trained, large, args.threads, repeats, args.out, args.seed)
        return 0

    return run


def repeat(parser: ArgumentParser) -> Runner:
    """One run of each committed table again, compared number by number; 1 if one differs on the same CPU and instruction set."""
    parser.add_argument("--results", type=Path, default=Path("results"), help="with runs.csv")
    parser.add_argument("--tables", nargs="+", default=[], help="labels; default: all")
    parser.add_argument(
        "--override", nargs="+", default=[], metavar="KEY=VALUE",
        help="where the photographs are, e.g. data.root=SCENE data.features=FOLDER",
    )  # fmt: skip

    def run(args: Namespace) -> int:
        from vlgs.bench.repeat import run_repeat

        most = 1 if args.quick else None
        rows = run_repeat(args.results, args.tables, args.override, args.out, args.seed, most)
        return 0 if all(row.holds for row in rows) else 1

    return run


SUBCOMMANDS: tuple[Callable[[ArgumentParser], Runner], ...] = (
    kernel,
    error,
    pareto,
    growth,
    train,
    unseen,
    threads,
    overhead,
    seams,
    iteration,
    reading,
    protocols,
    query,
    startup,
    repeat,
)
"""Name, help and options of a subcommand are those of its function; `all` runs them in this order."""

MOVED = {"stress": "tests.stress", "fuzz": "tests.fuzz_kernel"}
"""Former subcommands, which need a checkout, and the modules to run instead."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what is asked for; returns the exit status, 1 where a promise is broken or the input is wrong."""
    parser = ArgumentParser(prog="python -m vlgs.bench", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    common = ArgumentParser(add_help=False)
    common.add_argument("--quick", action="store_true", help="small scenes: does it run?")
    common.add_argument(
        "--out", type=Path, help="default: results/bench, or its quick/ with --quick"
    )
    common.add_argument("--seed", type=int, default=0)
    for subcommand in SUBCOMMANDS:
        own = commands.add_parser(
            subcommand.__name__, help=subcommand.__doc__, parents=[common],
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )  # fmt: skip
        own.set_defaults(runner=subcommand(own))
    everything = commands.add_parser("all", help="All of these.", parents=[common])
    everything.set_defaults(runner=_run_all)
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given and given[0] in MOVED:
        moved = f"it is python -m {MOVED[given[0]]} in a checkout"
        print(f"error: bench: subcommand must measure, got {given[0]}; {moved}", file=sys.stderr)
        return 1
    args = parser.parse_args(given)
    args.out = args.out or Path("results/bench/quick" if args.quick else "results/bench")
    try:
        return args.runner(args)
    except (ValueError, OSError) as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        from vlgs.runs import STOPPED

        print("stopped; what is written stays, and a training goes on from there", file=sys.stderr)
        return STOPPED


def _run_all(args: Namespace) -> int:
    """Every subcommand with its own defaults; a broken promise of one does not keep the others from running."""
    shared = ["--out", str(args.out), "--seed", str(args.seed), *(["--quick"] * args.quick)]
    return max(main([subcommand.__name__, *shared]) for subcommand in SUBCOMMANDS)


if __name__ == "__main__":
    sys.exit(main())
