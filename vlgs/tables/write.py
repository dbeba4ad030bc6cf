"""From finished runs to the files of the tables."""

import sys
from collections.abc import Sequence
from pathlib import Path

from vlgs.files import write_changed
from vlgs.identity import RESULTS_VERSION
from vlgs.tables.benchmark import Benchmark, Composer, UnknownOptionError
from vlgs.tables.fill import Filled, fill
from vlgs.tables.frame import (
    Line,
    add_kept,
    read_metrics,
    require_one_meaning,
    tidy,
    to_lines,
    write_frame,
)
from vlgs.tables.latex import document, to_latex
from vlgs.tables.markdown import to_csv, to_markdown
from vlgs.tables.registry import Table, is_label
from vlgs.text import to_bytes


def write_all(
    results: Path, tables: Sequence[Table], name: str | None = None, html: bool = False
) -> list[Path]:
    """Write the frame of all runs and the tables of every benchmark.

    Runs that have no folder here, as in a fresh clone, are taken from the frame that was written before.

    Args:
        results: Folder of the runs and of the benchmarks.
        tables: Which to write. One without a single run is left out, and so is one with options that the data of a benchmark do not
            have (faults of the supervision, on photographs).
        name: Only the tables of this benchmark.
        html: Write index.html with its plots too, of these tables.

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
    frame = tidy(lines)
    require_one_meaning(frame, results)
    write_frame(frame, results)
    current = [line for line in lines if line.results_version == RESULTS_VERSION]
    if len(current) < len(lines):
        _say_older(lines)
        if not current:
            return []  # and leave what was written of them as it is
    counted = tidy(current)
    refused: dict[str, UnknownOptionError] = {}
    fitting: set[str] = set()
    for file in files:
        benchmark = Benchmark.read(file)
        composer = Composer(benchmark, file.parent / "recipes.json")
        filled: list[Filled] = []
        for table in tables:
            try:
                filled.append(fill(table, benchmark, composer, counted))
                fitting.add(table.label)
            except UnknownOptionError as error:
                composer.require_sound(file)
                refused[table.label] = error
        composer.save()
        filled = [table for table in filled if len(table.runs)]
        write_tables(file.parent, filled)
        if html:
            from vlgs.tables.html import (
                write_report,  # matplotlib, which the tables alone do not wait for
            )

            write_report(file.parent, filled, frame, results)
    for label in refused.keys() - fitting:
        raise refused[label]
    return [file.parent for file in files]


def _say_older(lines: Sequence[Line]) -> None:
    versions = {line.config_hash: line.results_version for line in lines}
    older = [version for version in versions.values() if version != RESULTS_VERSION]
    print(
        f"{len(older)} runs are of results version {', '.join(map(str, sorted(set(older))))}, which no table mixes with version "
        f"{RESULTS_VERSION}: they stay in runs.csv, and tables that were written of them stay as they are",
        file=sys.stderr,
    )


def write_tables(folder: Path, filled: Sequence[Filled]) -> None:
    """Each table as csv, Markdown and LaTeX, and one document over all tables of the folder."""
    for table in filled:
        stem = folder / table.table.label
        write_changed(stem.with_suffix(".csv"), to_bytes(to_csv(table)))
        write_changed(stem.with_suffix(".md"), to_bytes(to_markdown(table)))
        write_changed(stem.with_suffix(".tex"), to_bytes(to_latex(table)))
    stems = (path.stem for path in folder.glob("*.tex"))
    labels = sorted(stem for stem in stems if stem != "tables" and is_label(stem))
    text = document(f"Ablations on {folder.name}", labels)
    write_changed(folder / "tables.tex", to_bytes(text))
