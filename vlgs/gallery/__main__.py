"""Draw the gallery of every benchmark below `results`: what each row of a table shows of the same views, and where it answers the same word.

    python -m vlgs.gallery                          the rows of sweeps/systems.yaml, seed 0, all scenes
    python -m vlgs.gallery name=synthetic tab=levels seed=1 scenes=glassware,mirrors
    python -m vlgs.gallery name=my-scene data.root=PATH

Two held-out views of a scene are drawn: those with the lowest and the highest mean PSNR over the rows. In each the word is asked on whose IoU
the rows differ most, among those whose labels cover 0.3 to 25 % of the view.

Keys: `results` (default ./results); `name` (one benchmark); `tab`; `seed`; `scenes`; `threads` (2); `data.root`, `data.labels`,
`data.features`, `data.vocabulary` where the photographs do not lie where the runs found them.
Writes <benchmark>/gallery/ with gallery.json, which `python -m vlgs.tables html=true` shows. Nothing is trained: a scene is drawn where its
runs have folders here, and else what was drawn before stays.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vlgs.config import MOST_THREADS, split_override
from vlgs.files import write_atomically
from vlgs.gallery.rows import ScoredRow, rows_of
from vlgs.identity import PLACES
from vlgs.names import file_names
from vlgs.runs import STOPPED
from vlgs.tables.benchmark import Benchmark, Composer, UnknownOptionError
from vlgs.tables.frame import read_metrics
from vlgs.tables.gallery import FOLDER, GalleryView, read_gallery, write_gallery
from vlgs.tables.registry import Table, choose, load_tables
from vlgs.text import screen, visible
from vlgs.values import require_range

_OWN = ("results", "name", "tab", "seed", "scenes", "threads")
_PLACES = PLACES - {"scene", "release"}


@dataclass(frozen=True)
class Request:
    """The command line, read."""

    results: Path
    name: str
    """Of a benchmark, or ``*``."""
    table: Table
    seed: int
    scenes: Sequence[str]
    """Empty: all."""
    threads: int
    places: Mapping[str, str]
    """Key of `data` -> folder or file on this machine."""


def main() -> None:
    """Read the command line and draw."""
    if sys.argv[1:2] in (["-h"], ["--help"]):
        print(__doc__)
        return
    try:
        draw_all(read(sys.argv[1:]))
    except (ValueError, OSError) as error:
        sys.exit(screen(f"error: {error}"))
    except KeyboardInterrupt:
        sys.exit(STOPPED)


def read(arguments: Sequence[str]) -> Request:
    """The keys of a command line.

    Raises:
        ValueError: Names the key and what it must be.
    """
    given = dict(map(split_override, arguments))
    places = {key.removeprefix("data."): value for key, value in given.items() if "." in key}
    unknown = sorted(set(given) - set(_OWN) - {f"data.{place}" for place in _PLACES})
    if unknown:
        known = ", ".join([*_OWN, *(f"data.{place}" for place in sorted(_PLACES))])
        raise ValueError(f"gallery: arguments must be KEY=VALUE of {known}, got {unknown[0]}")
    numbers = {key: _number(key, given.get(key, "")) for key in ("seed", "threads") if key in given}
    numbers = {"seed": 0, "threads": 2} | numbers
    require_range("gallery", 1, MOST_THREADS, threads=numbers["threads"])
    tables = choose([given.get("tab", "systems")], load_tables())
    if len(tables) != 1:
        raise ValueError("gallery: tab must be one table, got all")
    scenes = [word.strip() for word in given.get("scenes", "").split(",") if word.strip()]
    results = Path(given.get("results", "results"))
    return Request(results, given.get("name", "*"), tables[0], scenes=scenes, places=places, **numbers)  # fmt: skip


def draw_all(request: Request) -> None:
    """Draw every benchmark that was asked for, and say what was done and left.

    Raises:
        ValueError: If there is no such benchmark or scene, or a file is damaged; it is named.
        OSError: If a file cannot be read or written.
    """
    files = sorted(
        path
        for path in request.results.glob("*/benchmark.yaml")
        if request.name in ("*", path.parent.name)
    )
    if not files:
        raise ValueError(
            f"gallery: {request.results} must hold a benchmark ({request.name}/benchmark.yaml, written by python -m vlgs.ablate), got none"
        )
    benchmarks = [Benchmark.read(file) for file in files]
    known = {scene for benchmark in benchmarks for scene in benchmark.scenes}
    if unknown := [scene for scene in request.scenes if scene not in known]:
        raise ValueError(
            f"gallery: scenes must be of {', '.join(sorted(known))}, got {visible(unknown[0])}"
        )
    finished = read_metrics(request.results)
    for file, benchmark in zip(files, benchmarks, strict=True):
        composer = Composer(benchmark, file.parent / "recipes.json")
        try:
            found = rows_of(
                request.table, benchmark, composer, request.seed, finished, request.results / "runs"
            )
        except UnknownOptionError as error:  # as faults of the supervision are, of photographs
            _say(f"{benchmark.name}: left as it is, as a row of {request.table.label} has {error}")
            continue
        composer.save()
        for scene, rows in found.items():
            if not request.scenes or scene in request.scenes:
                _update(file.parent, scene, rows, request, benchmark)


def _update(
    folder: Path, scene: str, rows: Sequence[ScoredRow], request: Request, benchmark: Benchmark
) -> None:
    """Draw a scene where all is there, and say what became of it."""
    kept, tab = read_gallery(folder), request.table.label
    shown = {row.label for view in kept if (view.scene, view.tab) == (scene, tab) for row in view.rows}  # fmt: skip
    lacking = sorted(shown - {row.label for row in rows})
    where = f"{folder.name}: {scene}"
    if lacking or not rows:
        what = ", ".join(lacking) or f"any row of {tab}"
        _say(f"{where}: no run folder of {what} at seed {request.seed}; what is there stays")
        return
    import torch  # whom the command line and a clone without runs need not wait for

    from vlgs.gallery.draw import draw_scene

    torch.set_num_threads(request.threads)
    names = file_names(benchmark.scenes)
    drawn = draw_scene(rows, tab, f"{tab}-{names[scene]}", request.places)
    others = [view for view in kept if (view.scene, view.tab) != (scene, tab)]
    for name, picture in drawn.pictures.items():
        (folder / FOLDER / name).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / FOLDER / name, picture, durable=False)
    order = {scene: number for number, scene in enumerate(benchmark.scenes)}
    views = sorted([*others, *drawn.views], key=lambda v: (v.tab, order.get(v.scene, len(order))))
    write_gallery(folder, views)
    _sweep(folder / FOLDER, views)
    for note in drawn.notes:
        _say(f"{where}: {note}")
    count = len({row.label for view in drawn.views for row in view.rows})
    _say(f"{where}: {len(drawn.views)} views by {count} rows")


def _sweep(folder: Path, views: Sequence[GalleryView]) -> None:
    """Remove pictures that no view has any more, in the folders that views are drawn in."""
    named = {folder / name for view in views for name in view.files}
    for inner in {path.parent for path in named}:
        for path in inner.glob("*.jpg"):
            if path not in named:
                path.unlink()


def _number(key: str, text: str) -> int:
    if not text.isdecimal() or not text.isascii() or len(text) > 18:
        raise ValueError(f"gallery: {key} must be a whole number, got {text}")
    return int(text)


def _say(text: str) -> None:
    print(visible(text))


if __name__ == "__main__":
    main()
