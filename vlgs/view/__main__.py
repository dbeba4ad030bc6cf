"""Look around in a trained scene, and ask it for words, in a browser: `python -m vlgs.view RUN`; see `--help`."""

import argparse
import time
import webbrowser
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from vlgs.extras import require_extra
from vlgs.opened.commands import add_words, command, given_to_open, new_parser, opened
from vlgs.text import screen
from vlgs.values import require_range

if TYPE_CHECKING:
    from vlgs.view.shown import Shown

_HELP = """The pictures are those of vlgs.render and vlgs.query: relevancy as LERF-OVS measures it, the indicator, harmonics. They are coarse while
the camera moves where the machine is too slow for all pixels. The middle of the window is the optical axis, also where a photograph's principal
point lies elsewhere. A run that still trains is shown as of its newest checkpoint, and again when there is a newer one."""
_POLL = 1.0
"""Seconds between looks for a newer checkpoint."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Serve until Ctrl-C; exit status 1 and one line where that cannot be."""
    parser = new_parser("vlgs.view", __doc__, _HELP)
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="folder of a run; two are compared"
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="who may connect: 0.0.0.0 is everybody (this machine only)",
    )
    parser.add_argument(
        "--port", type=int, default=8080, help="0 is any that is free (%(default)s)"
    )
    parser.add_argument(
        "--open", action=argparse.BooleanOptionalAction, default=False, help="open a browser here"
    )
    parser.add_argument("--word", help="ask for it as soon as a browser comes")
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="OUT.png",
        help="write what a browser sees first, and end; needs no browser",
    )
    add_words(parser)
    args = parser.parse_args(arguments)
    with command():
        view(args)


def view(args: argparse.Namespace) -> None:
    """Serve the runs of a command line until Ctrl-C.

    Raises:
        ValueError: If a run cannot be opened, or an argument is wrong.
        OSError: If a file cannot be read, or the port is taken.
    """
    require_range("view", 0, 65535, port=args.port)
    if len(args.runs) > 2:
        raise ValueError(f"view: runs must be one or two, got {len(args.runs)}")
    if args.picture is None:
        require_extra("viser", "viewer")
    elif args.picture.suffix != ".png":
        raise ValueError(f"view: --picture must end in .png, got {args.picture}")
    runs = [opened(args, folder) for folder in args.runs]
    from vlgs.view.shown import Shown

    shown = [Shown(run) for run in runs]
    for one in shown:
        one.prepare()
    if args.word is not None:  # what cannot be encoded is said before anything is served
        for one in [one for one in shown if one.run.field.has_language] or shown:
            one.learn(args.word)
    if args.picture is None:
        serve(shown, args)
        return
    from vlgs.report.pictures import save_picture
    from vlgs.view.save import first_picture

    save_picture(args.picture, first_picture(shown, args.word).pixels)
    print(screen(f"{args.picture}"))


def serve(shown: list["Shown"], args: argparse.Namespace) -> None:
    """Wait for browsers until Ctrl-C.

    Args:
        shown: The runs, which are replaced where there is a newer checkpoint.
        args: Of the command line.

    Raises:
        OSError: If the port is taken.
    """
    from vlgs.opened import open_run
    from vlgs.view.server import Address, Server
    from vlgs.view.watch import Watch

    watch = Watch(shown, partial(open_run, **given_to_open(args)))
    server = Server(shown, Address(args.host, args.port), args.word)
    try:
        names = " and ".join(str(folder) for folder in args.runs)
        print(screen(f"{server.address.url} shows {names}; Ctrl-C ends"), flush=True)
        if args.open:
            webbrowser.open(server.address.url)
        while server.worker.failure is None:
            time.sleep(_POLL)
            if watch.poll():
                server.worker.ask_again()
        raise server.worker.failure
    finally:
        server.stop()


if __name__ == "__main__":
    main()
