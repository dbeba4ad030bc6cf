"""Write the tables of every benchmark below `results` from the runs that are there.

    python -m vlgs.tables                  all tables of all benchmarks (folders with a benchmark.yaml)
    python -m vlgs.tables tab=ab-multi     one table; several: tab=ab-multi,ab-cam
    python -m vlgs.tables results=FOLDER   other than ./results
    python -m vlgs.tables html=true        index.html with plots too

Writes results/runs.csv (one row per run, metric and category; runs.parquet with pyarrow), and per benchmark <label>.csv, .md and
.tex, and tables.tex over all of them. Nothing is trained, and nothing that has no run is filled in. Runs that stand in runs.csv and have
no folder here, as in a fresh clone, stay; delete the file to leave them out.
"""

import gc
import sys
from pathlib import Path

from vlgs.config import split_override
from vlgs.tables.registry import choose, load_tables
from vlgs.tables.write import write_all


def main() -> None:
    """Read the command line and write."""
    if len(sys.argv) > 1 and sys.argv[1] in ("-h", "--help"):
        print(__doc__)
        return
    given = dict(map(split_override, sys.argv[1:]))
    try:
        unknown = sorted(set(given) - {"tab", "results", "html"})
        if unknown:
            raise ValueError(f"tables: arguments must be tab=, results= or html=, got {unknown[0]}")
        if given.get("html", "false") not in ("true", "false"):
            raise ValueError(f"tables: html must be true or false, got {given['html']}")
        tables = choose(given.get("tab", "all").split(","), load_tables())
        results, html = Path(given.get("results", "results")), given.get("html") == "true"
        for path in write_all(results, tables, html=html):
            print(path)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    gc.disable()  # a short command that keeps nearly all it makes: looking for garbage was a sixth of its time
    main()
