"""From finished runs to the files of the tables."""

import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
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
        tables: Which to write. One without a single run is left out, and so is one with options that the data of a benchmark do not
            have (faults of the supervision, on photographs). One that another stands for elsewhere is that one.
        name: Only the tables of this benchmark, and nothing that is of all benchmarks.
        html: Write index.html of each benchmark with its plots too, and that over all, of these tables.
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
    found: dict[Path, _Found] = {}
    for file in files:
        there = [t for t in tables if (file.parent / f"{t.label}.csv").is_file()]
        found[file.parent] = _fill_all(file, there if again and there else tables, frames)
    named = {run: command for one in found.values() for run, command in one.commands.items()}
    lines = [
        line._replace(overrides=named.get((line.recipe, line.data_recipe), line.overrides))
        for line in lines
    ]
    write_lines(lines, results)
    for folder, one in found.items():
        write_tables(folder, one.filled)
    if name is None:
        write_document(results, list(found))
    if html:
        # Matplotlib, which the tables alone do not wait for.
        from vlgs.tables.html import write_report, write_site

        frame = tidy(lines)
        pages = [write_report(folder, one.filled, frame, results) for folder, one in found.items()]
        if name is None:
            write_site(results, pages)
    fitting = {label for one in found.values() for label in one.fitting}
    for one in found.values():
        for label in one.refused.keys() - fitting:
            raise one.refused[label]
    _say_older({folder: one.filled for folder, one in found.items()})
    return [file.parent for file in files]


@dataclass(frozen=True)
class _Found:
    """What a benchmark makes of the tables."""

    filled: list[Filled]
    """Those that are written."""
    fitting: set[str] = field(default_factory=set)
    """Labels of tables whose options its data has."""
    refused: dict[str, UnknownOptionError] = field(default_factory=dict)
    """Labels of the others, and why."""
    commands: dict[tuple[str, str], str] = field(default_factory=dict)
    """Recipe and data recipe of today's rows -> their overrides and the benchmark's."""


def _fill_all(file: Path, tables: Sequence[Table], frames: Mapping[int, pd.DataFrame]) -> _Found:
    """Each table from the first of the frames, by results version, that has runs of it."""
    benchmark = Benchmark.read(file)
    composer = Composer(benchmark, file.parent / "recipes.json")
    filled: dict[str, Filled] = {}
    found = _Found([])
    for version, frame in frames.items():
        current = version == RESULTS_VERSION
        recipes = composer if current else Recorded(benchmark, _recipes(frame))
        for table in tables:
            if table.label in filled:
                continue
            try:
                one = fill(table, benchmark, recipes, frame)
            except UnknownOptionError as error:
                composer.require_sound(file)
                found.refused[table.label] = error
                continue
            if current or RESULTS_VERSION not in frames:  # earlier runs know no options
                found.fitting.add(table.label)
            if current:
                found.commands.update(_commands(table, benchmark, composer))
            elsewhere = table.elsewhere and not one.same_scenes
            if len(one.runs) and not elsewhere:
                filled[table.label] = one
    if RESULTS_VERSION in frames:
        composer.save()
    found.filled.extend(filled[t.label] for t in tables if t.label in filled)
    return found


def _with_those_elsewhere(tables: Sequence[Table]) -> list[Table]:
    """The tables, and those that stand for some of them on other scenes."""
    labels = {table.label for table in tables}
    needed = {t.elsewhere: Path(t.source).parent for t in tables if t.elsewhere}
    more = [load_table(folder / f"{n}.yaml") for n, folder in needed.items() if n not in labels]
    return [*tables, *more]


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
        claims, path = claims_csv(table), folder / f"{table.table.label}-claims.csv"
        if claims is None:
            path.unlink(missing_ok=True)  # of runs that were more
        else:
            write_changed(path, to_bytes(claims))
    text = document(f"Ablations on {folder.name}", {"": _labels(folder)})
    write_changed(folder / "tables.tex", to_bytes(text))


def write_document(results: Path, folders: Sequence[Path]) -> None:
    """One LaTeX document over the tables of all benchmarks."""
    text = document("vlgs: results", {folder.name: _labels(folder) for folder in folders})
    write_changed(results / "tables.tex", to_bytes(text))


def _labels(folder: Path) -> list[str]:
    """Of the tables in LaTeX that stand in a folder."""
    stems = (path.stem for path in folder.glob("*.tex"))
    return sorted(stem for stem in stems if stem != "tables" and is_label(stem))
