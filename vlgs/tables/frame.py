"""Finished runs as one tidy frame, a line per run, metric and category; on disk one row per run, and a file of categories beside it."""

import csv
import io
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from vlgs.files import write_atomically, write_changed
from vlgs.finished import read_finished
from vlgs.text import csv_line, csv_text, screen, to_bytes

log = logging.getLogger(__name__)


class Line(NamedTuple):
    """One number of a run; all but the last four are the same in all lines of a run."""

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
    isa: str | None
    """Instruction set that the kernels used: another CPU or another set acts like another seed."""
    threads: int | None
    overrides: str | None
    """Command line of the row that the run fills: of its benchmark and its own, without scene and seed. None for runs of no row."""
    metric: str
    category: str
    """Of the metric ``per_category``, "" otherwise, as is `kind`."""
    kind: str
    value: float
    """NaN where it could not be computed."""


RUN_COLUMNS = Line._fields[: Line._fields.index("metric")]
"""What is the same in all lines of a run."""
_FLAT = RUN_COLUMNS[: RUN_COLUMNS.index("cpu")]
"""Of these, what stands in metrics.json as it is."""
_OPTIONAL = ("protocol", "commit", "cpu", "isa", "overrides")
CATEGORY_COLUMNS = ("config_hash", "category", "kind", "value")
PER_CATEGORY = "per_category"

DETAILS = {PER_CATEGORY, "category_kinds", "indicator", "per_view", "reasons", "machine", "skips"}
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
        machine = run.get("machine") or {}
        shared: dict[str, Any] = {name: run.get(name) for name in _FLAT}
        shared |= {"scene": str(run.get("scene"))}
        shared |= {name: machine.get(name) for name in ("cpu", "isa", "threads")}
        first = (*map(_storable, shared.values()), None)
        for metric, value in run.items():
            if metric in Line._fields or metric in DETAILS or isinstance(value, (str, dict, list)):
                continue
            lines.append(Line._make((*first, metric, "", "", _number(value))))
        kinds = run.get("category_kinds") or {}
        for category, value in (run.get("per_category") or {}).items():
            words = (category, kinds.get(category, ""))
            lines.append(Line._make((*first, PER_CATEGORY, *map(_storable, words), _number(value))))
    return lines


def _storable(value: Any) -> Any:
    """Text as runs.csv holds it: neither a file nor a column of pyarrow's takes halves of characters."""
    return to_bytes(value).decode() if isinstance(value, str) else value


def read_lines(results: Path) -> list[Line]:
    """The inverse of `write_lines`: runs.csv and categories.csv; empty if runs.csv is not there.

    Raises:
        ValueError: If a file is not as it was written; it is named.
    """
    if not (results / "runs.csv").is_file():
        return []
    runs: dict[str, tuple[Any, ...]] = {}
    lines: list[Line] = []
    rows = _rows(results / "runs.csv")
    metrics = _head(results / "runs.csv", rows, RUN_COLUMNS)
    for number, cells in rows:
        try:
            shared = _shared(cells[: len(RUN_COLUMNS)])
            values = cells[len(RUN_COLUMNS) :]
            for metric, value in zip(metrics, values, strict=True):
                if value:
                    lines.append(Line._make((*shared, metric, "", "", _finite(value))))
        except (IndexError, ValueError) as error:
            raise ValueError(_damaged(results / "runs.csv", number, error)) from error
        runs[shared[0]] = shared
    path = results / "categories.csv"
    rows = _rows(path)
    _head(path, rows, CATEGORY_COLUMNS, exactly=True)
    for number, cells in rows:
        try:
            name, category, kind, value = cells
            if name in runs:
                lines.append(
                    Line._make((*runs[name], PER_CATEGORY, category, kind, _finite(value)))
                )
        except ValueError as error:
            raise ValueError(_damaged(path, number, error)) from error
    return lines


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and cells of a CSV file."""
    if path.exists() and not path.is_file():  # a pipe would be waited for without end
        raise ValueError(_damaged(path, 1, "a folder or a device"))
    content = path.read_bytes()
    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        number = content.count(b"\n", 0, error.start) + 1
        raise ValueError(_damaged(path, number, "bytes that are not UTF-8")) from error
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    marked = "'" in text  # else no text was marked as one, which is quickly seen
    try:
        for row in rows:
            yield rows.line_num, list(map(csv_text, row)) if marked else row
    except csv.Error as error:
        raise ValueError(_damaged(path, rows.line_num, error)) from error


def _head(
    path: Path,
    rows: Iterator[tuple[int, list[str]]],
    wanted: Sequence[str],
    exactly: bool = False,
) -> list[str]:
    """The columns after those that are wanted."""
    _, head = next(rows, (1, []))
    if tuple(head[: len(wanted)]) != tuple(wanted) or (exactly and len(head) > len(wanted)):
        raise ValueError(_damaged(path, 1, f"columns {', '.join(head) or 'none'}"))
    return head[len(wanted) :]


def _shared(cells: Sequence[str]) -> tuple[Any, ...]:
    """What is the same in all lines of a run."""
    known: dict[str, Any] = dict(zip(RUN_COLUMNS, cells, strict=True))
    known |= {name: known[name] or None for name in _OPTIONAL}
    known |= {name: int(known[name]) for name in ("seed", "results_version")}
    known["threads"] = int(known["threads"]) if known["threads"] else None
    return tuple(known.values())


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"value {text}")
    return value


def _damaged(path: Path, line: int, got: object) -> str:
    return screen(
        f"{path}: line {line} must be as vlgs.tables writes it, got {got!s:.200}; take the file from version control, or delete "
        "runs.csv to leave out runs that have no folder here"
    )


def add_kept(found: Sequence[Line], results: Path) -> list[Line]:
    """The lines of all runs that have a folder and, from runs.csv, of runs whose folder is gone.

    A run with a folder takes the place of one without that fills the same row, scene and seed.

    Raises:
        ValueError: As `read_lines`.
    """
    taken = {_place(line) for line in found}
    known = read_lines(results)
    overrides = {line.config_hash: line.overrides for line in known}
    named = [line._replace(overrides=overrides.get(line.config_hash)) for line in found]
    here = {line.config_hash for line in found}
    kept = [line for line in known if line.config_hash not in here and _place(line) not in taken]
    if found and kept:
        log.warning(
            "%s: %d runs that have no folder here are kept; delete the file to leave them out",
            results / "runs.csv",
            len({line.config_hash for line in kept}),
        )
    return sorted([*named, *kept], key=lambda line: line.config_hash)


def _place(line: Line) -> tuple[str, str, str, int]:
    return line.recipe, line.data_recipe, line.scene, line.seed


def tidy(lines: Sequence[Line]) -> pd.DataFrame:
    """The fields of `Line` as columns."""
    return pd.DataFrame(lines, columns=pd.Index(Line._fields))


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def write_lines(lines: Sequence[Line], results: Path) -> None:
    """Write runs.csv, a row per run, and categories.csv; and runs.parquet, as `tidy` has it, where pyarrow is installed.

    What could not be computed is an empty cell, and a metric that no run has is no column.
    """
    runs: dict[str, tuple[Line, dict[str, float]]] = {}
    categories = [csv_line(CATEGORY_COLUMNS)]
    for line in lines:
        _, metrics = runs.setdefault(line.config_hash, (line, {}))
        if math.isnan(line.value):
            continue
        if line.metric == PER_CATEGORY:
            cells = (line.config_hash, line.category, line.kind, _shortest(line.value))
            categories.append(csv_line(cells))
        else:
            metrics[line.metric] = line.value
    names = sorted({name for _, metrics in runs.values() for name in metrics})
    rows = [csv_line([*RUN_COLUMNS, *names])]
    for first, metrics in runs.values():
        values = [_shortest(metrics[name]) if name in metrics else None for name in names]
        rows.append(csv_line([*first[: len(RUN_COLUMNS)], *values]))
    write_changed(results / "categories.csv", to_bytes("\n".join([*categories, ""])))
    write_changed(results / "runs.csv", to_bytes("\n".join([*rows, ""])))
    try:
        parquet = tidy(lines).to_parquet(index=False)
    except ImportError:
        return
    assert parquet is not None
    write_atomically(results / "runs.parquet", parquet)


def _shortest(value: float) -> float | int:
    """A whole number without a point; nothing is rounded."""
    return int(value) if value.is_integer() and abs(value) < 2**53 else value


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
