"""Ask a trained scene for words: `python -m vlgs.query RUN WORD...`; see `--help`."""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlgs.names import file_names
from vlgs.opened.commands import add_words, command, new_parser, opened
from vlgs.text import screen
from vlgs.values import require_range

if TYPE_CHECKING:
    from torch import Tensor

    from vlgs.opened import NamedCamera, OpenedRun
    from vlgs.opened.answers import Answers, Range
    from vlgs.queries import Questions

_HELP = """Writes for every word and view OUT/WORD/VIEW_heat.png (relevancy, from the lowest to the highest of the scene), _overlay.png (the same over
the picture) and _mask.png (what answers is white), and prints the views, the best first.

Relevancy is in [0, 1]; at 0.5 a pixel is as near to the word as to "object", "things", "stuff", "texture". It is averaged a little, as LERF-OVS
does. What lies above --threshold in the word's range over the held-out views answers, and nothing below 0.5. A view answers with the mask
level that has the largest relevancy. --select writes the Gaussians whose own code answers and that both colour and language draw (weight of at
least 1/255): nothing is rendered for it, so that what is hidden inside of things is chosen too."""


@dataclass(frozen=True)
class Row:
    """The answer of one view to one word."""

    word: str
    view: "NamedCamera"
    scores: dict[str, float]
    """Mask level -> largest relevancy."""
    level: str
    """The one that answers."""
    score: float
    peak: tuple[int, int]
    """Pixel (x, y) of the largest relevancy."""
    share: float
    """Of the pixels, that answer."""
    threshold: float
    """Relevancy from which on they do."""
    files: dict[str, str]


def main(arguments: Sequence[str] | None = None) -> None:
    """Answer on the screen and in pictures; exit status 1 and one line where that cannot be."""
    parser = new_parser("vlgs.query", __doc__, _HELP)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, finished or not")
    parser.add_argument(
        "words", nargs="+", metavar="WORD", help='what to look for: "glass of water"'
    )
    parser.add_argument(
        "--views",
        default="test",
        help="train, test, all, or names of photographs with commas between them (%(default)s)",
    )
    parser.add_argument(
        "--pose",
        metavar="FILE",
        help="cameras of a file in place of --views (see vlgs.render --help)",
    )
    parser.add_argument(
        "--threshold", type=float, help="of a word's range of relevancy, 0 to 1 (0.7)"
    )
    parser.add_argument("--level", type=int, help="mask level, 1 to 3 (the best of each view)")
    parser.add_argument("--out", type=Path, help="folder of the pictures (RUN/answers)")
    parser.add_argument("--no-pictures", action="store_true")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--select",
        type=Path,
        metavar="OUT.ply",
        help="write the Gaussians that answer the first word",
    )
    add_words(parser)
    args = parser.parse_args(arguments)
    with command():
        query(args)


def query(args: argparse.Namespace) -> None:
    """Do what the command line says.

    Raises:
        ValueError: If something that was asked for cannot be.
        OSError: If a file cannot be read or written.
    """
    require_range("query", 0, 1, threshold=args.threshold)
    run = opened(args)
    from vlgs.opened.answers import SHARE, ask_view, looked_at, ranges_of

    asked = run.ask(list(dict.fromkeys(args.words)))
    place = None if args.level is None else run.place(args.level)
    views = _views(run, args)
    cameras = looked_at([one.camera for one in run.held_out()])
    # Most are among the views that are asked for, and need not be asked again.
    known = {id(camera): ask_view(run.field, camera, asked) for camera in cameras}
    bounds = ranges_of([*known.values()], asked, place)
    share = SHARE if args.threshold is None else args.threshold
    if args.select is not None:
        count = _select(run, asked, bounds[0].threshold(share), place, args.select)
        line = f"{args.select}: {count} Gaussians answer {asked.prompts.names[0]!r}"
        print(screen(line), file=sys.stderr)
    out = None if args.no_pictures else (args.out or args.run / "answers")
    rows = _rows(run, asked, views, known, place, bounds, share, out)
    if args.json:
        print(json.dumps(_as_json(run, asked, rows), indent=1, ensure_ascii=False))
    else:
        _print(asked, rows, out)


def _views(run: "OpenedRun", args: argparse.Namespace) -> Sequence["NamedCamera"]:
    from vlgs.opened.cameras import cameras_of

    if args.pose is not None:
        return cameras_of(run, args.pose).frames
    if args.views == "all":
        return run.cameras()
    if args.views == "test" and not run.cameras("test"):  # every photograph was learned from
        return run.cameras("train")
    names = [args.views] if args.views in ("train", "test") else args.views.split(",")
    return [camera for name in names for camera in cameras_of(run, name.strip()).frames]


def _rows(
    run: "OpenedRun",
    asked: "Questions",
    views: Sequence["NamedCamera"],
    known: Mapping[int, "Answers"],
    place: int | None,
    bounds: Sequence["Range"],
    share: float,
    out: Path | None,
) -> list[Row]:
    """Of every word the views, the best first. No more than one view is held beside those that are known."""
    from vlgs.opened.answers import ask_view

    folders, files = file_names(asked.prompts.names), file_names(view.name for view in views)
    rows: list[Row] = []
    for view in views:
        answer = known.get(id(view.camera)) or ask_view(run.field, view.camera, asked)
        for word, name in enumerate(asked.prompts.names):
            threshold = bounds[word].threshold(share)
            at = answer.level(word, place)
            relevancy, written = answer.relevancy[at, word], dict[str, str]()
            answering = relevancy > threshold
            if out is not None:
                shown = bounds[word].shares(relevancy)
                written = _draw(out / folders[name] / files[view.name], answer, shown, answering)
            y, x = divmod(int(relevancy.argmax()), relevancy.shape[1])
            scores = {_level(run, i): float(s) for i, s in enumerate(answer.scores[:, word])}
            part = float(answering.float().mean())
            score = answer.score(word, place)
            level = _level(run, at)
            rows.append(Row(name, view, scores, level, score, (x, y), part, threshold, written))
    order = asked.prompts.names.index
    return sorted(rows, key=lambda row: (order(row.word), -row.score))


def _draw(stem: Path, answer: "Answers", shares: "Tensor", answering: "Tensor") -> dict[str, str]:
    """Three pictures of a view; returns their files by kind."""
    from vlgs.report import colors
    from vlgs.report.pictures import save_picture

    white = answering[..., None].expand(-1, -1, 3).byte() * 255
    over = colors.heat_over(colors.to_uint8(answer.color), shares)
    pictures = {"heat": colors.heat(shares), "overlay": over, "mask": white}
    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = {kind: stem.with_name(f"{stem.name}_{kind}.png") for kind in pictures}
    for kind, picture in pictures.items():
        save_picture(paths[kind], picture)
    return {kind: str(path) for kind, path in paths.items()}


def _select(
    run: "OpenedRun", asked: "Questions", threshold: float, place: int | None, path: Path
) -> int:
    from vlgs.gaussians.ply import write_ply
    from vlgs.opened.answers import select_gaussians

    if path.suffix != ".ply":
        raise ValueError(f"query: --select must end in .ply, got {path}")
    gaussians, chosen = select_gaussians(run.field, asked, 0, threshold, place)
    if not chosen.any():
        word = asked.prompts.names[0]
        raise ValueError(
            f"query: --select must leave a Gaussian, got none above a relevancy of {threshold:.3f} for {word!r}; a lower --threshold chooses more"
        )
    cloud = gaussians.point_cloud([one.camera for one in run.cameras("train")])
    params = {name: value[chosen] for name, value in cloud.params.items()}
    write_ply(path, params, notes=cloud.notes)
    return int(chosen.sum())


def _level(run: "OpenedRun", place: int) -> str:
    return str(run.levels[place]) if run.levels else "-"


def _as_json(run: "OpenedRun", asked: "Questions", rows: Sequence[Row]) -> dict[str, Any]:
    answers = [
        {**vars(row), "view": row.view.name, "split": row.view.split, "peak": list(row.peak)}
        for row in rows
    ]
    return {
        "run": str(run.path),
        "scene": run.notes.name,
        "words": list(asked.prompts.names),
        "query": type(asked.query).__name__,
        "note": asked.note,
        "answers": answers,
    }


def _print(asked: "Questions", rows: Sequence[Row], out: Path | None) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    for word in asked.prompts.names:
        table = Table("view", "relevancy", "level", "at pixel", "answers", title=Text(screen(word)))
        for row in rows:
            if row.word == word:
                x, y = row.peak
                cells = (f"{row.score:.3f}", row.level, f"{x}, {y}", f"{100 * row.share:.1f} %")
                table.add_row(Text(screen(row.view.name)), *cells)
        console.print(table)
    if asked.note:
        console.print(Text(screen(asked.note)))
    if out is not None:
        console.print(Text(f"pictures in {out}"))


if __name__ == "__main__":
    main()
