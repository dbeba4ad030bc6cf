"""The columns of log.csv, and a reader that keeps the intact lines of a damaged file."""

import csv
import io
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

log = logging.getLogger(__name__)

COLUMNS = ("step", "loss", "psnr", "n_gaussians", "blend_weight", "seconds")


def csv_lines(rows: Sequence[Sequence[object]]) -> str:
    """Rows as lines of log.csv."""
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue()


def read_rows(path: Path) -> list[list[str]]:
    """The intact rows; a warning counts the others. No result depends on this file.

    Columns are found by name, and by place where no header names them.
    """
    lines = path.read_bytes().splitlines(keepends=True)
    names = _cells(lines[0]) if lines else []
    if "step" in names:
        lines = lines[1:]
    else:
        names = list(COLUMNS)
    rows = [dict(zip(names, _cells(line), strict=False)) for line in lines]
    kept = [[row[name] for name in COLUMNS] for row in rows if _is_whole(row)]
    if len(kept) < len(lines):
        log.warning(
            "log: %s has %d rows that cannot be read and are left out", path, len(lines) - len(kept)
        )
    return kept


def _cells(line: bytes) -> list[str]:
    """Cells of one line; none where it is no text or its end is missing."""
    if not line.endswith((b"\n", b"\r")):
        return []
    try:
        return next(csv.reader([line.decode("utf-8-sig")]), [])
    except (UnicodeDecodeError, csv.Error):
        return []


def _is_whole(row: Mapping[str, str]) -> bool:
    try:
        int(row["step"])
        for name in COLUMNS:
            float(row[name])
    except (KeyError, ValueError):
        return False
    return True
