"""Write the tables of every benchmark below `results` from the runs that are there.

    python -m vlgs.tables                  all tables of all benchmarks (folders with a benchmark.yaml)
    python -m vlgs.tables tab=ab-multi     one table; several: tab=ab-multi,ab-cam
    python -m vlgs.tables results=FOLDER   other than ./results

Writes results/runs.csv (one row per run, metric and category; runs.parquet with pyarrow), and per benchmark <label>.csv, .md and
.tex, tables.tex and index.html. Nothing is trained, and nothing that has no run is filled in.
"""

import sys
from pathlib import Path

from vlgs.config import split_override
from vlgs.files import write_atomically
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.fill import Filled, fill
from vlgs.tables.frame import read_metrics, require_one_meaning, tidy, write_frame
from vlgs.tables.latex import document, to_latex
from vlgs.tables.markdown import to_csv, to_markdown
from vlgs.tables.registry import Table, choose, load_tables


def main() -> None:
    """Read the command line and write."""
    if len(sys.argv) > 1 and sys.argv[1] in ("-h", "--help"):
        print(__doc__)
        return
    given = dict(map(split_override, sys.argv[1:]))
    try:
        unknown = sorted(set(given) - {"tab", "results"})
        if unknown:
            raise ValueError(f"tables: arguments must be tab= or results=, got {unknown[0]}")
        results = Path(given.get("results", "results"))
        tables = choose(given.get("tab", "all").split(","), load_tables())
        for path in write_all(results, tables):
            print(path)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")


def write_all(results: Path, tables: list[Table]) -> list[Path]:
    """Write the frame and the tables of every benchmark.

    Returns:
        The folders that were written.

    Raises:
        ValueError: If there is no benchmark, or runs that must not stand in one table.
    """
    files = sorted(results.glob("*/benchmark.yaml"))
    if not files:
        raise ValueError(
            f"tables: {results} must hold a benchmark (<name>/benchmark.yaml, written by python -m vlgs.ablate), got none"
        )
    frame = tidy(read_metrics(results))
    require_one_meaning(frame)
    write_frame(frame, results)
    folders = []
    for file in files:
        benchmark = Benchmark.read(file)
        composer = Composer(benchmark, results / "cache" / "recipes.json")
        filled = [fill(table, benchmark, composer, frame) for table in tables]
        composer.save()
        _write(file.parent, [f for f in filled if len(f.runs)])
        folders.append(file.parent)
    return folders


def _write(folder: Path, filled: list[Filled]) -> None:
    for table in filled:
        stem = folder / table.table.label
        write_atomically(stem.with_suffix(".csv"), to_csv(table).encode())
        write_atomically(stem.with_suffix(".md"), to_markdown(table).encode())
        write_atomically(stem.with_suffix(".tex"), to_latex(table).encode())
    labels = [table.table.label for table in filled]
    title = f"Ablations on {folder.name}"
    write_atomically(folder / "tables.tex", document(title, labels).encode())


if __name__ == "__main__":
    main()
