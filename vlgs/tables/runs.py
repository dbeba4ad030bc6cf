"""One line per run of a folder: what differs between the runs, their scores, and where they lie. Needs no registry and no torch."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.cells import cell_len

from vlgs.config import CONF
from vlgs.files import write_atomically
from vlgs.finished import read_finished
from vlgs.identity import PLACES, moves
from vlgs.known import renamed
from vlgs.runs import RunFolder
from vlgs.tables.registry import read_yaml
from vlgs.text import csv_line, latex, markdown, screen, to_bytes, visible

log = logging.getLogger(__name__)

SCORES = (
    ("psnr", "PSNR dB", 1.0, 2),
    ("ssim", "SSIM", 1.0, 4),
    ("miou", "mIoU %", 100.0, 1),
    ("loc_acc", "accuracy %", 100.0, 1),
    ("n_gaussians", "Gaussians", 1.0, 0),
    ("train_seconds", "training s", 1.0, 1),
)
"""Entry of metrics.json, header, factor, digits after the point."""

MISSING = "--"

_NAMES = ("dataset", "scene")
"""Entries of metrics.json that tell runs apart as options do."""


@dataclass(frozen=True)
class Run:
    """One line."""

    path: Path
    options: Mapping[str, str]
    """What was chosen; only what differs between the runs is shown."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """Empty without results."""
    state: str = ""
    """Why there are none."""


@dataclass(frozen=True)
class RunTable:
    """A header and a row per run, of text and numbers; None where there is no number."""

    head: tuple[str, ...]
    rows: tuple[tuple[str | int | float | None, ...], ...]
    digits: Mapping[str, int]

    def text(self) -> str:
        """Columns for a terminal, however wide it is: paths can be copied."""
        lines = [list(map(visible, self.head)), *self._printed(visible)]
        widths = [max(map(cell_len, column)) for column in zip(*lines, strict=True)]
        return "\n".join(
            "  ".join(
                " " * (width - cell_len(cell)) + cell
                if name in self.digits
                else cell + " " * (width - cell_len(cell))
                for name, cell, width in zip(self.head, line, widths, strict=True)
            ).rstrip()
            for line in lines
        )

    def write(self, path: Path) -> None:
        """Write it as the file's name says.

        Raises:
            ValueError: If the name ends in something else, see `require_format`.
        """
        require_format(path)
        if path.suffix == ".csv":
            lines = [csv_line(self.head), *map(csv_line, self.rows)]
        elif path.suffix == ".tex":  # needs booktabs
            aligned = "".join("r" if name in self.digits else "l" for name in self.head)
            body = [" & ".join(row) + r" \\" for row in self._printed(latex)]
            top = " & ".join(map(latex, self.head)) + r" \\"
            lines = [rf"\begin{{tabular}}{{{aligned}}}", r"\toprule", top, r"\midrule", *body]
            lines += [r"\bottomrule", r"\end{tabular}"]
        else:
            cells = [map(markdown, self.head), ["---"] * len(self.head), *self._printed(markdown)]
            lines = ["| " + " | ".join(row) + " |" for row in cells]
        write_atomically(path, to_bytes("\n".join([*lines, ""])))

    def _printed(self, neutral: Any) -> list[list[str]]:
        return [
            [
                neutral(cell)
                if isinstance(cell, str)
                else MISSING
                if cell is None
                else f"{cell:,.{self.digits[name]}f}"
                for name, cell in zip(self.head, row, strict=True)
            ]
            for row in self.rows
        ]


def require_format(path: Path) -> None:
    """Do nothing if a table can be written to a file of this name.

    Raises:
        ValueError: If it ends in something else.
    """
    if path.suffix not in (".csv", ".md", ".tex"):
        raise ValueError(f"tables: write must end in .csv, .md or .tex, got {path.name}")


def read_runs(folder: Path) -> list[Run]:
    """The runs in a folder: of a folder of results, of its ``runs``, of any folder of run folders, or one run alone.

    One whose metrics.json is damaged is left out, with a warning.

    Raises:
        ValueError: If there is no finished run.
    """
    places = ("metrics.json", "*/metrics.json", "runs/*/metrics.json")
    paths = sorted({path for place in places for path in folder.glob(place)})
    runs = []
    for path in paths:
        try:
            metrics = read_finished(path)
        except (ValueError, OSError) as error:
            log.warning("%s", screen(f"this run is left out: {error}"))
            continue
        runs.append(Run(path.parent, _options(RunFolder(path.parent), metrics), metrics))
    if not runs:
        raise ValueError(
            f"tables: {folder} must hold finished runs (metrics.json, */metrics.json or runs/*/metrics.json), "
            f"got {len(paths) or 'none'}{' damaged' if paths else ''}"
        )
    return runs


def compare(runs: Sequence[Run]) -> RunTable:
    """Columns of the options that differ, of the scores that any run has, and of where each run lies."""
    differing = _differing([run.options for run in runs])
    scores = [s for s in SCORES if any(run.metrics.get(s[0]) is not None for run in runs)]
    states = ["state"] if any(run.state for run in runs) else []
    rows = []
    for run in runs:
        values = [run.metrics.get(entry) for entry, *_ in scores]
        numbers = [
            None if value is None else round(value * factor, digits) if digits else int(value)
            for value, (_, _, factor, digits) in zip(values, scores, strict=True)
        ]
        chosen = [run.options.get(key, "") for key in differing]
        rows.append((*chosen, *numbers, str(run.path), *([run.state] if states else [])))
    head = (*differing, *(header for _, header, _, _ in scores), "run", *states)
    return RunTable(head, tuple(rows), {header: digits for _, header, _, digits in scores})


def _options(folder: RunFolder, metrics: Mapping[str, Any]) -> dict[str, str]:
    """Everything that can move a number, as ``key -> value``; a group's ``_target_`` stands under the group's own name."""
    options = {name: str(metrics[name]) for name in _NAMES if metrics.get(name) is not None}
    content: Any = {}
    if folder.config.is_file():
        try:
            content = read_yaml(folder.config)
        except (ValueError, OSError) as error:
            log.warning("%s", screen(f"its options are left out: {error}"))
    if not isinstance(content, dict):
        return options
    data = content.get("data")
    kept = {key: value for key, value in content.items() if key != "data"}
    if isinstance(data, dict):
        kept["data"] = {k: v for k, v in data.items() if k not in (*PLACES, "_target_")}
    named = ((renamed(key) or key, value) for key, value in _leaves(kept, ""))
    return options | {key: _shown(key, value) for key, value in named if moves(key)}


def _leaves(node: Any, key: str, depth: int = 0) -> Iterable[tuple[str, Any]]:
    """Dotted key and value of everything that is no mapping."""
    if (
        isinstance(node, dict) and depth < 10
    ):  # deeper than any configuration, shallower than a stranger's
        for name, child in node.items():
            own = key if name == "_target_" else f"{key}.{name}".lstrip(".")
            yield from _leaves(child, own, depth + 1)
    else:
        yield key, node


def _shown(group: str, value: Any) -> str:
    """A value; of a class in the configuration the option that it is, where that is but one."""
    if isinstance(value, list) and any(isinstance(v, dict) for v in value):  # stages of a method
        return "+".join(
            str(v.get("_target_", v)).rpartition(".")[2] if isinstance(v, dict) else str(v)
            for v in value
        )[:80]
    if isinstance(value, (list, dict)):
        return f"{len(value)} entries" if len(value) > 8 else ",".join(f"{v!s:.40}" for v in value)
    text = str(value)
    options = sorted((CONF / group).glob("*.yaml")) if group.isidentifier() else []
    if not options:
        return text
    named = [path.stem for path in options if f"_target_: {text}" in path.read_text().splitlines()]
    return named[0] if len(named) == 1 else text.rpartition(".")[2]


def _differing(options: Sequence[Mapping[str, str]]) -> list[str]:
    """Keys whose values differ; what only some classes of a group have differs where those that have it do."""
    values: dict[str, set[str]] = {}
    counts: dict[str, int] = {}
    for chosen in options:
        for key, value in chosen.items():
            values.setdefault(key, set()).add(value)
            counts[key] = counts.get(key, 0) + 1
    found = {key for key, different in values.items() if len(different) > 1}
    for key, count in counts.items():
        group = key.rpartition(".")[0]
        if count < len(options) and not _within(group, found):
            found.add(key)
    return [key for key in values if key in found]


def _within(group: str, keys: set[str]) -> bool:
    """Whether a group, or what it stands in, is among the keys."""
    while group:
        if group in keys:
            return True
        group = group.rpartition(".")[0]
    return False
