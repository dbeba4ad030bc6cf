"""Write the tables of every benchmark below `results` from the runs that are there.

    python -m vlgs.tables                  the tables that stand in each benchmark's folder (with a benchmark.yaml), again
    python -m vlgs.tables tab=ab-multi     one table; several: tab=ab-multi,ab-cam; all that have runs: tab=all
    python -m vlgs.tables results=FOLDER   other than ./results
    python -m vlgs.tables html=true        index.html of each benchmark, with plots, and one page over all of them too
    python -m vlgs.tables FOLDER           one line for each run of any folder of runs: what differs, scores, where it lies
    python -m vlgs.tables FOLDER write=F   the same to a file F.csv, F.md or F.tex

Writes results/runs.csv (one row per run) and categories.csv (one per run and category; both in runs.parquet with pyarrow), and per
benchmark <label>.csv, .md and .tex, <label>-claims.csv with every difference, interval and verdict, and tables.tex over all of them; and
results/tables.tex over all benchmarks. Pages show the pictures that `python -m vlgs.gallery` drew.
Nothing is trained, and nothing that has no run is filled in. Runs that stand in runs.csv and have no folder here, as in a fresh clone, stay;
delete the file to leave them out. A table of runs of earlier code is written from them and says so.
"""

import gc
import sys
from collections.abc import Mapping
from pathlib import Path

from vlgs.config import split_override
from vlgs.tables.registry import choose, load_tables
from vlgs.tables.runs import compare, read_runs, require_format
from vlgs.tables.write import write_all
from vlgs.text import screen


def main() -> None:
    """Read the command line and write."""
    if len(sys.argv) > 1 and sys.argv[1] in ("-h", "--help"):
        print(__doc__)
        return
    folder = sys.argv[1] if len(sys.argv) > 1 and Path(sys.argv[1]).is_dir() else ""
    given = dict(map(split_override, sys.argv[2 if folder else 1 :]))
    try:
        if folder:
            _compare(Path(folder), given)
            return
        unknown = sorted(set(given) - {"tab", "results", "html"})
        if unknown:
            raise ValueError(
                f"tables: arguments must be tab=, results=, html= or a folder of runs, got {unknown[0]}"
            )
        if given.get("html", "false") not in ("true", "false"):
            raise ValueError(f"tables: html must be true or false, got {given['html']}")
        tables = choose(given.get("tab", "all").split(","), load_tables())
        results, html = Path(given.get("results", "results")), given.get("html") == "true"
        for path in write_all(results, tables, html=html, again="tab" not in given):
            print(path)
    except (ValueError, OSError) as error:
        sys.exit(screen(f"error: {error}"))


def _compare(folder: Path, given: Mapping[str, str]) -> None:
    """One line per run of a folder."""
    if unknown := sorted(set(given) - {"write"}):
        raise ValueError(f"tables: with a folder, arguments must be write=, got {unknown[0]}")
    out = Path(given["write"]) if "write" in given else None
    if out is not None:
        require_format(out)
    table = compare(read_runs(folder))
    print(table.text())
    if out is not None:
        table.write(out)


if __name__ == "__main__":
    gc.disable()  # a short command that keeps nearly all it makes: looking for garbage was a sixth of its time
    main()
