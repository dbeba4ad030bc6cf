"""Finished runs as one tidy frame: a line per run, metric and category."""

import csv
import io
import logging
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from vlgs.files import write_atomically, write_changed
from vlgs.finished import read_finished
from vlgs.text import csv_cell, csv_line, csv_text, screen, to_bytes

log = logging.getLogger(__name__)


class Line(NamedTuple):
    """One number of a run; all but the last four are the same in all lines of a run, as in metrics.json."""

    config_hash: str
    recipe: str
    data_recipe: str
    dataset: str
    scene: str
    seed: int
    protocol: str | None
    results_version: int
    commit: str | None
    cpu: str | None
    metric: str
    category: str
    """Of the metric ``per_category``, "" otherwise, as is `kind`."""
    kind: str
    value: float
    """NaN where it could not be computed."""


RUN_COLUMNS = Line._fields[: Line._fields.index("cpu")]

DETAILS = {"per_category", "category_kinds", "indicator", "per_view", "reasons", "machine", "skips"}
"""Entries of metrics.json that are not one value."""
MOST_PLACES = 6
"""Runs that an error lists."""


def read_metrics(results: Path) -> list[dict[str, Any]]:
    """Contents of metrics.json of every finished run below `results`/runs; one that is damaged is left out, with a warning."""
    runs = []
    for path in sorted((results / "runs").glob("*/metrics.json")):
        try:
            runs.append(read_finished(path))
        except (ValueError, OSError) as error:
            log.warning("%s", screen(f"this run is left out: {error}"))
    return runs


def to_lines(runs: Iterable[Mapping[str, Any]]) -> list[Line]:
    """Every number of every run.

    Args:
        runs: Contents of metrics.json files; those from before runs said which row they fill are left out.
    """
    lines = []
    for run in runs:
        if "recipe" not in run:
            continue
        shared: dict[str, Any] = {name: run.get(name) for name in RUN_COLUMNS}
        shared |= {"scene": str(run.get("scene")), "cpu": (run.get("machine") or {}).get("cpu")}
        first = tuple(shared.values())
        for metric, value in run.items():
            if metric in RUN_COLUMNS or metric in DETAILS or isinstance(value, (str, dict, list)):
                continue
            lines.append(Line._make((*first, metric, "", "", _number(value))))
        kinds = run.get("category_kinds") or {}
        for category, value in (run.get("per_category") or {}).items():
            kind = kinds.get(category, "")
            lines.append(Line._make((*first, "per_category", category, kind, _number(value))))
    return lines


def read_lines(results: Path, without: Collection[str] = ()) -> list[Line]:
    """The inverse of `write_frame`: runs.csv; empty if it is not there.

    Args:
        results: Folder that it lies in.
        without: Runs (`Line.config_hash`) that are not wanted.

    Raises:
        ValueError: If the file is not such a frame; it is named.
    """
    path = results / "runs.csv"
    if not path.is_file():
        return []
    content = path.read_bytes()
    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        number = content.count(b"\n", 0, error.start) + 1
        raise ValueError(_damaged(path, number, "bytes that are not UTF-8")) from error
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    marked = "'" in text  # else no text was marked as one, which is quickly seen
    try:
        head = next(rows, [])
        if tuple(head) != Line._fields:
            raise ValueError(f"columns {', '.join(head) or 'none'}")
        if marked:
            return [_line(*map(csv_text, row)) for row in rows if csv_text(row[0]) not in without]
        return [_line(*row) for row in rows if row[0] not in without]
    except (IndexError, TypeError, ValueError, csv.Error) as error:
        said = "too few or too many cells" if isinstance(error, (IndexError, TypeError)) else error
        raise ValueError(_damaged(path, rows.line_num, said)) from error


def _damaged(path: Path, line: int, got: object) -> str:
    return screen(
        f"{path}: line {line} must be as vlgs.tables writes it, got {got!s:.200}; take the file from version control, or delete it "
        "to leave out runs that have no folder here"
    )


def add_kept(found: Sequence[Line], results: Path) -> list[Line]:
    """The lines of all runs that have a folder and, from runs.csv, of runs whose folder is gone.

    A run with a folder takes the place of one without that fills the same row, scene and seed.

    Raises:
        ValueError: As `read_lines`.
    """
    taken = {_place(line) for line in found}
    others = read_lines(results, without={line.config_hash for line in found})
    kept = [line for line in others if _place(line) not in taken]
    if found and kept:
        log.warning(
            "%s: %d runs that have no folder here are kept; delete the file to leave them out",
            results / "runs.csv",
            len({line.config_hash for line in kept}),
        )
    return sorted([*found, *kept], key=lambda line: line.config_hash)


def _place(line: Line) -> tuple[str, str, str, int]:
    return line.recipe, line.data_recipe, line.scene, line.seed


def _line(*row: str) -> Line:
    line = Line(*row)  # pyright: ignore[reportArgumentType]
    value = float(line.value) if line.value else math.nan
    if line.value and not math.isfinite(value):
        raise ValueError(f"value {line.value}")
    return line._replace(
        seed=int(line.seed),
        results_version=int(line.results_version),
        value=value,
        **{name: getattr(line, name) or None for name in ("protocol", "commit", "cpu")},
    )


def tidy(lines: Sequence[Line]) -> pd.DataFrame:
    """The fields of `Line` as columns."""
    return pd.DataFrame(lines, columns=pd.Index(Line._fields))


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def write_frame(frame: pd.DataFrame, results: Path) -> None:
    """Write runs.csv, and runs.parquet where pyarrow is installed."""
    cells: list[Sequence[str]] = []
    for name in frame.columns:
        column = frame[name].tolist()
        # A text stands in thousands of lines: it is made a cell once.
        known = {} if name == "value" else {value: csv_cell(value) for value in set(column)}
        cells.append([known[value] if known else csv_cell(value) for value in column])
    lines = [csv_line(frame.columns), *map(",".join, zip(*cells, strict=True)), ""]
    write_changed(results / "runs.csv", to_bytes("\n".join(lines)))
    try:
        parquet = frame.to_parquet(index=False)
    except ImportError:
        return
    assert parquet is not None
    write_atomically(results / "runs.parquet", parquet)


def require_one_meaning(frame: pd.DataFrame, results: Path) -> None:
    """Refuse what must not stand in one table.

    Args:
        frame: As from `tidy`.
        results: Folder that the runs were read from.

    Raises:
        ValueError: If two runs claim one recipe, data, scene and seed, or runs of one data set differ in protocol; it says where
            the runs stand.
    """
    runs = frame.drop_duplicates("config_hash")
    same = runs[runs.duplicated(["recipe", "data_recipe", "scene", "seed"], keep=False)]
    if len(same):
        first = same.iloc[0]
        twins = same[
            (
                same[["recipe", "data_recipe", "scene", "seed"]]
                == first[["recipe", "data_recipe", "scene", "seed"]]
            ).all(axis=1)
        ]
        raise ValueError(
            f"{results}: runs of one row, scene {first['scene']} and seed {first['seed']} must be one, got "
            f"{_places(twins['config_hash'], results)}, whose data differ; remove all but one"
        )
    for (recipe, data), group in runs.groupby(["recipe", "data_recipe"]):
        protocols = sorted(set(group["protocol"].dropna()))
        if len(protocols) > 1:
            raise ValueError(
                f"{results}: runs of recipe {recipe} on data {data} must share a protocol, got {', '.join(protocols)} in "
                f"{_places(group['config_hash'], results)}; remove those of all but one"
            )


def _places(runs: Iterable[str], results: Path) -> str:
    """Where each run stands, a few of them."""
    names, folders = list(runs), {path.parent for path in (results / "runs").glob("*/metrics.json")}
    found = []
    for name in names[:MOST_PLACES]:
        folder = results / "runs" / name
        found.append(str(folder) if folder in folders else f"{name:.80} of {results / 'runs.csv'}")
    more = [f"{len(names) - MOST_PLACES} more"] if len(names) > MOST_PLACES else []
    return ", ".join(found + more)
