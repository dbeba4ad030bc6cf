"""Pages to look at: one per benchmark, and one over all of them. They need no network, and no script to be read."""

import itertools
import json
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from vlgs.files import write_changed
from vlgs.tables import plots
from vlgs.tables.budget_plot import differences_by_budget
from vlgs.tables.fill import Filled
from vlgs.tables.frame import Line
from vlgs.tables.gallery import GalleryView, read_gallery
from vlgs.tables.grid import Entry, arrange, caption, has_paper, means_first, number
from vlgs.tables.grid import Line as GridLine
from vlgs.tables.said import say
from vlgs.text import to_bytes, visible

BENCH = {
    "growth.png": "Time of a training step's render against Gaussians, pixels, channels and threads.",
    "pareto.png": "Time and error of every preset and switch, against float64 without cut-offs.",
    "pareto_rounding.png": "The same against float64 with the same cut-offs: rounding alone.",
    "query.png": "An answer to a word beside the two renders that it needs.",
    "train.png": "Quality on held-out views over the seconds of training, by recipe.",
    "unseen.png": "Quality at views that nobody photographed, by number of training views.",
    "unseen_worst.png": "Held-out views that go wrong, or went wrong before.",
}
"""Picture of `results/bench` -> what it shows. Others are shown under their names."""


@dataclass(frozen=True)
class Picture:
    """A plot as a PNG file."""

    file: str
    """Below the folder of its page."""
    title: str
    """What it shows."""
    size: tuple[int, int] | None
    """Width and height in pixels, so that a page keeps its shape while pictures come; None where the file does not say."""


@dataclass(frozen=True)
class Page:
    """What is shown of a benchmark."""

    name: str
    about: Sequence[str]
    """Which code, data and seeds."""
    tables: Sequence[dict[str, Any]]
    whole: Sequence["Picture"]
    """Those that are of no single table."""
    gallery: Sequence[GalleryView]
    notes: bool
    """Whether a README.md stands beside it."""


def write_report(
    folder: Path, filled: Sequence[Filled], frame: pd.DataFrame, results: Path
) -> Page:
    """Write index.html of a benchmark and its plots (plots/*.png).

    Args:
        folder: Of the benchmark.
        filled: Its tables that have runs.
        frame: As `vlgs.tables.frame.tidy` returns it.
        results: Where the runs lie.

    Raises:
        ValueError: If gallery.json is damaged.
    """
    pictures = folder / "plots"
    pictures.mkdir(exist_ok=True)

    def keep(name: str, title: str, png: bytes | None) -> Picture | None:
        if png is not None:
            write_changed(pictures / f"{name}.png", png)
        # Curves need the folders of runs, which a clone does not have: it shows those that were drawn where they lay.
        kept = (pictures / f"{name}.png").is_file()
        return _picture(folder, f"plots/{name}.png", title) if kept else None

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
    page = Page(
        name=folder.name,
        about=_about(filled),
        tables=[
            _section(
                table,
                keep(
                    label := table.table.label,
                    f"{label} as a plot",
                    differences_by_budget(table) or plots.rows_compared(table),
                ),
            )
            for table in filled
        ],
        whole=[found for title, name, png in whole if (found := keep(name, title, png))],
        gallery=read_gallery(folder),
        notes=(folder / "README.md").is_file(),
    )
    text = _environment().get_template("benchmark.html.j2").render(page=page)
    write_changed(folder / "index.html", to_bytes(text))
    return page


def write_site(results: Path, pages: Sequence[Page]) -> None:
    """Write index.html over all benchmarks, and what the benchmark of the code itself drew (`results/bench`)."""
    names = sorted(path.name for path in (results / "bench").glob("*.png"))
    bench = [_picture(results, f"bench/{name}", BENCH.get(name, name)) for name in names]
    text = (
        _environment()
        .get_template("site.html.j2")
        .render(
            pages=pages,
            notes=(results / "README.md").is_file(),
            bench=bench,
            bench_notes=(results / "bench" / "README.md").is_file(),
        )
    )
    write_changed(results / "index.html", to_bytes(text))


def _picture(folder: Path, file: str, title: str) -> Picture:
    with (folder / file).open("rb") as content:
        start = content.read(24)
    sized = len(start) == 24 and start[:8] == b"\x89PNG\r\n\x1a\n"
    return Picture(file, title, struct.unpack(">II", start[16:]) if sized else None)


def _environment() -> Environment:
    """Templates in which every text from outside stays text."""
    return Environment(
        loader=PackageLoader("vlgs.tables", "pages"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_shown,
    )


def _shown(value: Any) -> Any:
    """What a template prints: one line where it is text; what a macro made stays as it is."""
    return visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _about(filled: Sequence[Filled]) -> list[str]:
    """Where the numbers of a benchmark come from, in few lines."""
    if not filled:
        return ["No table has runs."]
    runs = pd.concat([table.runs for table in filled]).drop_duplicates("config_hash")
    benchmark = filled[0].benchmark
    seeds = sorted(int(seed) for seed in runs["seed"].unique())
    of = {name: _listed(runs[name]) for name in ("results_version", "protocol", "commit", "cpu")}
    return [
        f"{len(filled)} tables of {len(runs)} runs; scenes {', '.join(benchmark.scenes)}; seeds {', '.join(map(str, seeds))}",
        f"Results version {of['results_version']}; protocol {of['protocol']}; commit {of['commit']}; machine {of['cpu']}",
        f"python -m vlgs.ablate {' '.join(benchmark.overrides)}",
    ]


def _listed(values: "pd.Series[Any]") -> str:
    """Distinct values; of a commit, which is long, its first letters and whether there were local changes."""
    said = {str(int(v)) if isinstance(v, float) else str(v) for v in values.dropna().unique()}
    commits = values.name == "commit"
    short = {f"{one[:8]}{'+dirty' * one.endswith('+dirty')}" if commits else one for one in said}
    return ", ".join(sorted(short)) or "not recorded"


def _section(filled: Filled, picture: Picture | None) -> dict[str, Any]:
    grid, paper = means_first(arrange(filled)), has_paper(filled)
    said = say(filled)
    marks = len(grid.mark_names)
    groups = itertools.groupby(grid.lines, key=lambda line: line.group)
    return {
        "label": filled.table.label,
        "caption": caption(filled).replace("+-", "±"),
        "head": [
            "category" if filled.table.by_category else "row",
            *grid.mark_names,
            *grid.headers,
        ],
        "groups": [
            {"name": name, "lines": [_line(line, marks, paper) for line in lines]}
            for name, lines in groups
        ],
        "said": said,
        "claimed": bool(said.lines),
        "provenance": filled.provenance,
        "picture": picture,
    }


def _line(line: GridLine, marks: int, paper: bool) -> dict[str, Any]:
    return {
        "label": line.label,
        "marks": [*line.marks, *[False] * (marks - len(line.marks))],
        "entries": [_entry(entry, paper) for entry in line.entries],
    }


def _entry(entry: Entry, paper: bool) -> dict[str, Any]:
    return {
        "text": entry.text,
        "value": f"{entry.mean:.10g}" if math.isfinite(entry.mean) else "",
        "std": number(entry.std, entry.digits) if math.isfinite(entry.std) else "",
        "rank": entry.rank,
        "paper": number(entry.paper, entry.digits) if paper and math.isfinite(entry.paper) else "",
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
