"""What the commands on an opened run have in common. Imports no torch before a run is opened."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlgs.config import MOST_THREADS
from vlgs.runs import STOPPED
from vlgs.text import screen
from vlgs.values import require_range

if TYPE_CHECKING:
    from vlgs.opened.run import OpenedRun


def new_parser(module: str, description: str | None, epilog: str) -> argparse.ArgumentParser:
    """The parser of a command, whose help keeps the line breaks of both texts."""
    return argparse.ArgumentParser(
        prog=f"python -m {module}",
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_words(parser: argparse.ArgumentParser) -> None:
    """Options that say where vectors of words come from, how many threads there are, and whose parts are trusted."""
    group = parser.add_argument_group("words that the run's vocabulary lacks")
    group.add_argument("--vocabulary", type=Path, metavar="FILE", help="further words and vectors")
    group.add_argument(
        "--text",
        metavar="MODEL",
        help="CLIP or SigLIP: a name in the local Hugging Face cache or a folder",
    )
    group.add_argument(
        "--template",
        default="{}",
        help='sentence around a word for --text, "a photo of a {}" (%(default)s)',
    )
    parser.add_argument(
        "--within",
        type=float,
        default=0.0,
        metavar="ERROR",
        help="by how much a cosine with a word may be off: at 0.005 many answers of one scene take a hundredth of the time (%(default)g: by rounding)",
    )
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (%(default)s)")
    parser.add_argument(
        "--plugins",
        nargs="+",
        action="extend",
        default=[],
        metavar="PACKAGE",
        help="packages of your own that the run has parts of, after everything else: my_lab",
    )


def given_to_open(args: argparse.Namespace) -> dict[str, Any]:
    """Arguments of `vlgs.opened.open_run` on a command line with `add_words`."""
    names = ("vocabulary", "text", "template", "within", "plugins")
    return {name: getattr(args, name) for name in names}


def opened(args: argparse.Namespace, folder: Path | None = None) -> "OpenedRun":
    """The run of a command line with `add_words`; says on the screen if it still trains.

    Raises:
        ValueError: See `vlgs.opened.open_run`.
        OSError: Likewise.
    """
    require_range("command", 1, MOST_THREADS, threads=args.threads)
    import torch

    from vlgs.opened.run import open_run

    torch.set_num_threads(args.threads)
    run = open_run(folder or args.run, **given_to_open(args))
    if run.step is not None:
        print(f"{run.path}: not finished, shown as of step {run.step}", file=sys.stderr)
    return run


@contextmanager
def command() -> Iterator[None]:
    """End the process with one line that says what is wrong, and with what shells expect of Ctrl-C."""
    try:
        yield
    except (ValueError, OSError) as error:
        sys.exit(screen(f"error: {error}"))
    except KeyboardInterrupt:
        sys.exit(STOPPED)
