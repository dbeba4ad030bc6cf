"""Write a trained scene to one file: `python -m vlgs.export RUN OUT`; see `--help`."""

import argparse
import sys
from pathlib import Path

from vlgs.export import Wanted, export, kind_of
from vlgs.opened import open_run
from vlgs.text import screen

_HELP = """OUT, by suffix:

  .html            a page that opens from disk without a network: look around, ask the words, jump to the photographs' cameras
  .ply             3DGS
  .compressed.ply  PlayCanvas and SuperSplat; 16 bytes a Gaussian, and one for each harmonic
  .splat           32 bytes a Gaussian; no view dependence

All hold colours as they are drawn, with no fusion left to be done. `python -m vlgs.convert RUN OUT` also writes codes and indicators."""


def main(arguments: list[str] | None = None) -> None:
    """Export one run; exit status 1 with one line if it cannot be done."""
    parser = argparse.ArgumentParser(
        prog="python -m vlgs.export",
        description=__doc__,
        epilog=_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument(
        "--words",
        metavar="A,B",
        help="of a page, with commas between them; default: the scene's classes",
    )
    parser.add_argument("--select", metavar="WORD", help="only the Gaussians that answer it")
    parser.add_argument("--level", type=int, metavar="N", help="mask level that answers")
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help="further words")
    parser.add_argument(
        "--text", metavar="MODEL", help="CLIP or SigLIP for words that no vocabulary has"
    )
    parser.add_argument(
        "--most", type=int, metavar="N", help="keep the N Gaussians with the largest opacity x area"
    )
    parser.add_argument(
        "--harmonics", type=int, choices=range(4), help="highest degree to keep; default: all"
    )
    given = parser.parse_args(arguments)
    if given.most is not None and given.most < 1:
        parser.error(f"--most must be 1 or more, got {given.most}")
    wanted = Wanted(_split(given.words), given.select, given.level, given.most, given.harmonics)
    try:
        kind_of(given.out)  # before anything is loaded
        opened = open_run(given.run, given.vocabulary, given.text)
        for line in export(opened, given.out, wanted):
            sys.stdout.write(f"{screen(line)}\n")
    except (ValueError, OSError) as error:
        sys.exit(screen(f"error: {error}"))


def _split(words: str | None) -> list[str] | None:
    return words if words is None else [w for part in words.split(",") if (w := part.strip())]


if __name__ == "__main__":
    main()
