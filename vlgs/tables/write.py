"""From finished runs to the files of the tables."""

import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pandas as pd

from vlgs.files import write_changed
from vlgs.identity import RESULTS_VERSION
from vlgs.tables.benchmark import Benchmark, Composer, Recorded, UnknownOptionError
from vlgs.tables.fill import Filled, fill
from vlgs.tables.frame import (
    add_kept,
    read_metrics,
    require_one_meaning,
    tidy,
    to_lines,
    write_lines,
)
from vlgs.tables.latex import document, to_latex
from vlgs.tables.markdown import to_csv, to_markdown
from vlgs.tables.registry import Table, is_label, load_table
from vlgs.tables.said import claims_csv
from vlgs.text import to_bytes


def write_all(
    results: Path,
    tables: Sequence[Table],
    name: str | None = None,
    html: bool = False,
    again: bool = False,
) -> list[Path]:
    """Write the frame of all runs and the tables of every benchmark.

    Runs that have no folder here, as in a fresh clone, are taken from the frame that was written before. A table is written from the
    latest results version that has runs of it, and never mixes two.

    Args:
        results: Folder of the runs and of the benchmarks.
        tables: Which to write. One that has runs of fewer than two rows is left out, and so is one with options that the data of a
            benchmark do not have (faults of the supervision, on photographs).
        name: Only the tables of this benchmark.
        html: Write index.html with its plots too, of these tables.
        again: In a folder that has some of the tables, write those only.

    Returns:
        The folders that were written.

    Raises:
        ValueError: If there is no benchmark or no run, or runs that must not stand in one table, or a table has an option that no benchmark
            has.
    """
    files = sorted(results.glob(f"{name or '*'}/benchmark.yaml"))
    if not files:
        raise ValueError(
            f"tables: {results} must hold a benchmark ({name or '<name>'}/benchmark.yaml, written by python -m vlgs.ablate), "
            "got none"
        )
    lines = add_kept(to_lines(read_metrics(results)), results)
    if not lines:
        raise ValueError(
            f"tables: {results} must hold finished runs (runs/*/metrics.json) or runs.csv, got neither"
        )
    require_one_meaning(tidy(lines), results)
    tables = _with_those_elsewhere(tables)
    versions = sorted({line.results_version for line in lines}, reverse=True)
    frames = {v: tidy([line for line in lines if line.results_version == v]) for v in versions}
    written: dict[Path, list[Filled]] = {}
    refused: dict[str, UnknownOptionError] = {}
    fitting: set[str] = set()
    named: dict[tuple[str, str], str] = {}
    for file in files:
        benchmark = Benchmark.read(file)
        composer = Composer(benchmark, file.parent / "recipes.json")
        filled: dict[str, Filled] = {}
        wanted = tables
        if again:
            there = [t for t in tables if (file.parent / f"{t.label}.csv").is_file()]
            wanted = there or tables
        for version, frame in frames.items():
            current = version == RESULTS_VERSION
            recipes = composer if current else Recorded(benchmark, _recipes(frame))
            for table in wanted:
                if table.label in filled:  # with runs of a later version
                    continue
                try:
                    found = fill(table, benchmark, recipes, frame)
                    fitting.add(table.label)
                except UnknownOptionError as error:
                    composer.require_sound(file)
                    refused[table.label] = error
                    continue
                if current:
                    named |= _commands(table, benchmark, composer)
                if _compares(found):
                    filled[table.label] = found
        if RESULTS_VERSION in frames:
            composer.save()
        written[file.parent] = [filled[t.label] for t in wanted if t.label in filled]
    lines = [
        line._replace(overrides=named.get((line.recipe, line.data_recipe), line.overrides))
        for line in lines
    ]
    write_lines(lines, results)
    for folder, found in written.items():
        write_tables(folder, found)
        if html:
            from vlgs.tables.html import (
                write_report,  # matplotlib, which the tables alone do not wait for
            )

            write_report(folder, found, tidy(lines), results)
    for label in refused.keys() - fitting:
        raise refused[label]
    _say_older(written)
    return [file.parent for file in files]


def _with_those_elsewhere(tables: Sequence[Table]) -> list[Table]:
    """The tables, and those that stand for some of them on other scenes."""
    labels = {table.label for table in tables}
    needed = {t.elsewhere: Path(t.source).parent for t in tables if t.elsewhere}
    more = [load_table(folder / f"{n}.yaml") for n, folder in needed.items() if n not in labels]
    return [*tables, *more]


def _compares(filled: Filled) -> bool:
    """Whether a table has something to say: two of its rows have runs, unless it has but one, and no other says it of these scenes."""
    if filled.table.elsewhere and not filled.same_scenes:
        return False
    rows = len({row.overrides for row in filled.table.rows})
    return len(filled.runs[["recipe", "data_recipe"]].drop_duplicates()) >= min(2, rows)


def _recipes(frame: pd.DataFrame) -> Iterator[tuple[str, str, str | None]]:
    """What each run of a frame is and was asked for with."""
    columns = ["recipe", "data_recipe", "overrides"]
    return frame.drop_duplicates("config_hash")[columns].itertuples(index=False, name=None)


def _commands(table: Table, benchmark: Benchmark, composer: Composer) -> dict[tuple[str, str], str]:
    """Recipe and data recipe of every row -> its overrides and its benchmark's."""
    found = {}
    for row in table.rows:
        known = composer.identity(row.overrides, 0)
        found[known.recipe, known.data] = shlex.join((*benchmark.recorded, *row.overrides))
    return found


def _say_older(written: Mapping[Path, Sequence[Filled]]) -> None:
    """Which tables are made of runs of earlier code."""
    for folder, filled in written.items():
        older = [f for f in filled if f.results_version != RESULTS_VERSION]
        versions = ", ".join(map(str, sorted({f.results_version for f in older})))
        if older:
            print(
                f"{folder}: {len(older)} tables are of runs of results version {versions}, as they say; today's code is version "
                f"{RESULTS_VERSION}, and no table mixes versions",
                file=sys.stderr,
            )


def write_tables(folder: Path, filled: Sequence[Filled]) -> None:
    """Each table as csv, Markdown and LaTeX, and one document over all tables of the folder."""
    for table in filled:
        stem = folder / table.table.label
        write_changed(stem.with_suffix(".csv"), to_bytes(to_csv(table)))
        write_changed(stem.with_suffix(".md"), to_bytes(to_markdown(table)))
        write_changed(stem.with_suffix(".tex"), to_bytes(to_latex(table)))
        claims = claims_csv(table)
        if claims is not None:
            write_changed(folder / f"{table.table.label}-claims.csv", to_bytes(claims))
    stems = (path.stem for path in folder.glob("*.tex"))
    labels = sorted(stem for stem in stems if stem != "tables" and is_label(stem))
    text = document(f"Ablations on {folder.name}", labels)
    write_changed(folder / "tables.tex", to_bytes(text))
