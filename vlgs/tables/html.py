"""One page per benchmark: every table with what it says and a plot, then the runs behind them."""

import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment

from vlgs.files import write_atomically
from vlgs.tables import plots
from vlgs.tables.fill import Filled
from vlgs.tables.frame import Line
from vlgs.tables.grid import arrange, caption, has_paper, number
from vlgs.tables.said import say
from vlgs.text import to_bytes, visible


def write_report(
    folder: Path, filled: Sequence[Filled], frame: pd.DataFrame, results: Path
) -> None:
    """Write index.html and its pictures (plots/*.png).

    Args:
        folder: Of the benchmark.
        filled: Its tables that have runs.
        frame: As `vlgs.tables.frame.tidy` returns it.
        results: Where the runs lie.
    """
    pictures = folder / "plots"
    pictures.mkdir(exist_ok=True)

    def keep(name: str, png: bytes | None) -> str:
        if png is not None:
            write_atomically(pictures / f"{name}.png", png)
        # Curves need the folders of runs, which a clone does not have: it shows those that were drawn where they lay.
        return f"plots/{name}.png" if (pictures / f"{name}.png").is_file() else ""

    hashes = {name for table in filled for name in table.runs["config_hash"]}
    mine = frame[frame["config_hash"].isin(hashes)]
    full = _full_model(filled)
    whole = [
        ("Training time against mIoU", "time", plots.time_against_score(mine, _titles(filled))),
        (
            "Learning curves of the full model",
            "curves",
            plots.learning_curves(_curves(full, results)),
        ),
        (
            "Indicator minus opacity in the full model, by kind of category",
            "indicator",
            plots.indicator_by_kind(_histograms(full, results)),
        ),
    ]
    page = Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: visible(value) if isinstance(value, str) else value,
    ).from_string(resources.files("vlgs.tables").joinpath("report.html.j2").read_text())
    text = page.render(
        name=folder.name,
        tables=[
            _section(table, keep(table.table.label, plots.rows_compared(table))) for table in filled
        ],
        whole=[(title, path) for title, name, png in whole if (path := keep(name, png))],
    )
    write_atomically(folder / "index.html", to_bytes(text))


def _section(filled: Filled, picture: str) -> dict[str, Any]:
    grid, paper = arrange(filled), has_paper(filled)
    return {
        "label": filled.table.label,
        "caption": caption(filled),
        "head": ["", *grid.mark_names, *grid.headers],
        "lines": [
            {
                "group": line.group,
                "label": line.label,
                "marks": ["✓" if mark else "" for mark in line.marks]
                + [""] * (len(grid.mark_names) - len(line.marks)),
                "entries": [
                    {
                        "text": entry.text,
                        "std": number(entry.std, entry.digits) if entry.std == entry.std else "",
                        "rank": entry.rank,
                        "paper": number(entry.paper, entry.digits)
                        if paper and entry.paper == entry.paper
                        else "",
                    }
                    for entry in line.entries
                ],
            }
            for line in grid.lines
        ],
        "said": say(filled),
        "provenance": filled.provenance,
        "picture": picture,
    }


def _titles(filled: Sequence[Filled]) -> dict[str, str]:
    """Recipe -> the first row that runs it."""
    titles: dict[str, str] = {}
    for table in filled:
        for index, recipe in table.recipes.items():
            row = table.table.rows[index]
            titles.setdefault(recipe, "full model" if row.overrides == () else row.label)
    return titles


def _full_model(filled: Sequence[Filled]) -> list[Line]:
    """Runs of the configuration without overrides."""
    for table in filled:
        for index, recipe in table.recipes.items():
            if table.table.rows[index].overrides == ():
                runs = table.runs[table.runs["recipe"] == recipe].sort_values(["scene", "seed"])
                return [Line(*run) for run in runs.itertuples(index=False)]
    return []


def _curves(runs: Sequence[Line], results: Path) -> dict[str, list[pd.DataFrame]]:
    curves: dict[str, list[pd.DataFrame]] = {}
    for run in runs:
        path = results / "runs" / run.config_hash / "log.csv"
        if path.is_file():
            curves.setdefault(run.scene, []).append(_curve(path))
    return curves


def _curve(path: Path) -> pd.DataFrame:
    """What can be read of a log.csv; no number of a table depends on it."""
    columns = ["step", "psnr"]
    try:
        rows = pd.read_csv(
            path, usecols=columns, encoding_errors="replace", on_bad_lines="skip", dtype=str
        )
    except ValueError:  # empty, or without these columns
        return pd.DataFrame(columns=columns, dtype=float)
    return rows.apply(pd.to_numeric, errors="coerce").dropna()


def _histograms(runs: Sequence[Line], results: Path) -> list[dict[str, list[float]]]:
    found = []
    for run in runs:
        path = results / "runs" / run.config_hash / "metrics.json"
        metrics = json.loads(path.read_text()) if path.is_file() else {}
        if metrics.get("indicator"):
            found.append(metrics["indicator"])
    return found
