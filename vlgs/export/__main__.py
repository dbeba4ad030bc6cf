"""Write a trained scene to one file: `python -m vlgs.export RUN OUT`; see `--help`."""

from pathlib import Path

from vlgs.export import Wanted, export, kind_of
from vlgs.opened.commands import add_words, command, new_parser, opened
from vlgs.text import screen

_HELP = """OUT, by suffix:

  .html            a page that opens from disk without a network: look around, ask the words, jump to the photographs' cameras
  .ply             3DGS
  .compressed.ply  PlayCanvas and SuperSplat; 16 bytes a Gaussian, and one for each harmonic
  .splat           32 bytes a Gaussian; no view dependence

All hold colours as they are drawn, with no fusion left to be done. `python -m vlgs.convert RUN OUT` also writes codes and indicators."""


def main(arguments: list[str] | None = None) -> None:
    """Export one run; exit status 1 with one line if it cannot be done."""
    parser = new_parser("vlgs.export", __doc__, _HELP)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument(
        "--words",
        metavar="A,B",
        help="of a page, with commas between them; default: the scene's classes",
    )
    parser.add_argument("--select", metavar="WORD", help="only the Gaussians that answer it")
    parser.add_argument("--level", type=int, metavar="N", help="mask level that answers")
    parser.add_argument(
        "--most", type=int, metavar="N", help="keep the N Gaussians with the largest opacity x area"
    )
    parser.add_argument(
        "--harmonics", type=int, choices=range(4), help="highest degree to keep; default: all"
    )
    add_words(parser)
    args = parser.parse_args(arguments)
    with command():
        kind_of(args.out)  # before anything is loaded
        wanted = Wanted(_split(args.words), args.select, args.level, args.most, args.harmonics)
        for line in export(opened(args), args.out, wanted):
            print(screen(line))


def _split(words: str | None) -> list[str] | None:
    return words if words is None else [w for part in words.split(",") if (w := part.strip())]


if __name__ == "__main__":
    main()
