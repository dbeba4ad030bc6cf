"""What a benchmark leaves behind: a CSV file that says how it was made, a picture, and a table on the screen."""

import csv
import io
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from vlgs.files import write_atomically
from vlgs.ops.machine import instruction_set
from vlgs.places import without_places
from vlgs.report.provenance import commit, machine

if TYPE_CHECKING:
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.typing import RcKeyType

STYLE: "dict[RcKeyType, Any]" = {
    "font.family": "sans-serif",
    "font.size": 8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.linewidth": 0.3,
    "grid.alpha": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 7,
    "svg.fonttype": "none",
}
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#555555", "#000000")
"""Told apart by every kind of colour vision (Okabe and Ito)."""
DPI = 200
FEW_DECADES = 300.0
"""Up to this ratio of its ends an axis has room for three labels a decade."""


def provenance(seed: int | None, program: str = "vlgs.bench", **notes: object) -> dict[str, object]:
    """Who measured what: the lines above a CSV. Ask for it before measuring, so that the load is that of the others.

    Args:
        seed: Of what was drawn.
        program: The module that was run.
        notes: Further lines, or others in the place of those above.
    """
    load = f"{os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else "unknown"
    return {
        "command": shlex.join(["python", "-m", program, *without_places(sys.argv[1:])]),
        **machine(),
        "isa": instruction_set(),
        "load": f"{load} (one-minute average when it began)",
        "commit": commit(),
        "seed": seed,
        **notes,
    }


def flatten(row: Any) -> dict[str, Any]:
    """A dataclass as columns; a nested one, or a mapping, gives columns with its name in front."""
    columns: dict[str, Any] = {}
    for field in fields(row):
        value = getattr(row, field.name)
        if is_dataclass(value):
            value = flatten(value)
        if isinstance(value, Mapping):
            columns |= {f"{field.name}_{key}": inner for key, inner in value.items()}
        else:
            columns[field.name] = value
    return columns


def write_record(path: Path, rows: Sequence[Any], header: Mapping[str, object]) -> None:
    """One line per row (dataclasses of one kind), under comments that say who measured; whole or not at all.

    Raises:
        ValueError: If there is nothing to write.
        OSError: If it cannot be written.
    """
    if not rows:
        raise ValueError(f"bench: rows of {path.name} must be at least 1, got 0")
    table = [flatten(row) for row in rows]
    text = io.StringIO(newline="")
    text.writelines(f"# {key}: {value}\n" for key, value in header.items())
    writer = csv.DictWriter(text, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _short(value) for key, value in line.items()} for line in table)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text.getvalue().encode())


def read_record(path: Path) -> pd.DataFrame:
    """The rows of such a file.

    Raises:
        FileNotFoundError: If it is not there; says which command makes it.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"bench: {path} must exist, got none; python -m vlgs.bench {path.stem} makes it"
        )
    names = ("run", "commit", "worst_view")  # which may be digits alone
    return pd.read_csv(path, comment="#", dtype=dict.fromkeys(names, str))


def plain_ticks(axis: "Axis") -> None:
    """Label a logarithmic axis at 1, 2 and 5 of every decade, as plain numbers; at 1 and 3 where there are many decades.

    To be called after plotting: it goes by what is drawn.
    """
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    low, high = axis.get_data_interval()
    axis.set_major_locator(LogLocator(subs=(1, 3) if high > FEW_DECADES * low else (1, 2, 5)))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def write_figure(stem: Path, figure: "Figure") -> list[Path]:
    """A picture to look at (PNG) and one to print (PDF), whole or not at all."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = []
    for suffix, metadata in ((".png", {}), (".pdf", {"CreationDate": None})):
        data = io.BytesIO()
        figure.savefig(data, format=suffix[1:], dpi=DPI, metadata=metadata, bbox_inches="tight")
        paths.append(stem.with_suffix(suffix))
        write_atomically(paths[-1], data.getvalue())
    return paths


def show(title: str, columns: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    """Print a table that is not squeezed: what does not fit a narrow terminal wraps there."""
    table = Table(title=escape(title), title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(escape(name), justify="left" if i == 0 else "right", no_wrap=True)
    for line in lines:
        table.add_row(*map(escape, line))
    plain = Console()
    widest = plain.measure(table, options=plain.options.update(width=1000)).maximum
    Console(width=max(plain.width, widest)).print(table)


def say(text: str) -> None:
    """A line on the screen, as it is."""
    Console().print(text, highlight=False, markup=False, soft_wrap=True)


def _short(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value
