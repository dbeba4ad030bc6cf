"""The registry of ablations: one YAML file per table in `sweeps`, read and checked. Imports no torch.

A row is a command line: `{label, set: [Hydra overrides], paper: values}`. The paper's values are kept as printed and never
stand in for a run. `sweeps/README.md` describes every key.
"""

import importlib.resources
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from vlgs.finished import is_number
from vlgs.tables.quantities import QUANTITIES
from vlgs.text import visible

_CHECKOUT = Path(__file__).resolve().parents[2] / "sweeps"
SWEEPS = (
    _CHECKOUT if _CHECKOUT.is_dir() else Path(str(importlib.resources.files("vlgs"))) / "sweeps"
)
"""Folder of the registry: beside the package in a checkout, inside it in an installed wheel."""

AVERAGE = "avg"
"""Column of the mean over scenes."""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The safe loader in C where PyYAML has it: ten times as fast."""

DEEPEST = 100
"""Lists and mappings in each other that a file may have."""

_TABLE_KEYS = {
    "label",
    "number",
    "caption",
    "dataset",
    "scenes",
    "metrics",
    "by",
    "categories",
    "seeds",
    "elsewhere",
    "same_runs_as",
    "against",
    "rows",
}
_ROW_KEYS = {"label", "set", "group", "marks", "paper", "ours"}
_EMPTY: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    label: str
    overrides: tuple[str, ...]
    """Hydra overrides that make the run."""
    group: str = ""
    """Part of the table that the row belongs to."""
    marks: Mapping[str, bool] = field(default_factory=lambda: _EMPTY)
    """Switches printed as check marks in columns of their own."""
    paper: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: _EMPTY)
    """Column (the paper's scene, ``avg``, or a category) -> metric -> the value printed in the paper."""
    ours: str = ""
    """Why a row that the paper does not have is here."""


@dataclass(frozen=True)
class Table:
    """One table: what is compared, and what the paper printed."""

    label: str
    """LaTeX label without ``tab:``; also the file's name."""
    caption: str
    dataset: str
    """Option of conf/data whose scenes the paper's values belong to."""
    scenes: Mapping[str, str]
    """The paper's name of a scene -> `data.scene`."""
    metrics: tuple[str, ...]
    """Keys of `QUANTITIES`."""
    rows: tuple[Row, ...]
    by_category: bool = False
    """Columns are the categories of a scene instead of scenes."""
    number: int | None = None
    """Number of the table in the paper's PDF, by which comments cite it; None for a table of our own."""
    kinds: Mapping[str, str] = field(default_factory=lambda: _EMPTY)
    """Category -> ``translucent_reflective`` or ``other``."""
    seeds: tuple[int, ...] = ()
    """The only seeds that are run; empty for those of the benchmark."""
    elsewhere: str = ""
    """Table that stands for this one on other scenes than the paper's, where this would say the same of other scenes again."""
    same_runs_as: str = ""
    """Table that has all of these rows, so that on other scenes than the paper's only the paper's values are others."""
    against: str = ""
    """Label of the row that others are compared with; empty for the full model."""
    source: str = "sweeps"
    """File that it was read from, for errors."""

    def chosen(self, seeds: Sequence[int]) -> tuple[int, ...]:
        """Those of a benchmark's seeds that the table is made of."""
        return tuple(seed for seed in seeds if not self.seeds or seed in self.seeds)


def is_label(text: str) -> bool:
    """Whether a text may be a label: it is a file's name and goes into LaTeX as it is."""
    return re.fullmatch(r"\w[\w.-]*", text, re.ASCII) is not None


def load_tables(folder: Path = SWEEPS) -> dict[str, Table]:
    """Read the whole registry, sorted by label.

    Raises:
        ValueError: Names the file, the key and what it must be.
    """
    tables = [load_table(path) for path in sorted(folder.glob("*.yaml"))]
    if not tables:
        raise ValueError(f"sweeps: {folder} must hold tables (*.yaml), got none")
    return {table.label: table for table in tables}


def choose(labels: Sequence[str], tables: Mapping[str, Table]) -> list[Table]:
    """The tables of that name, with or without ``tab:``; ``all`` is every one. What ends in ``.yaml`` is the file of a table of one's own.

    Raises:
        ValueError: Names the label and lists those that exist, or what is wrong with the file.
        OSError: If the file cannot be read.
    """
    names = dict.fromkeys(label.removeprefix("tab:") for label in labels)
    if "all" in names:
        return list(tables.values())
    chosen = []
    for name in names:
        if name.endswith(".yaml"):
            chosen.append(load_table(Path(name)))
            if chosen[-1].label in tables:
                raise ValueError(f"tab: {name} must have a label of its own, got that of ours")
        elif name in tables:
            chosen.append(tables[name])
        else:
            known = ", ".join(tables)
            raise ValueError(f"tab: must be all, one of {known}, or a file of yours, got {name}")
    return chosen


def load_table(path: Path) -> Table:
    """Read one file of the registry.

    Raises:
        ValueError: Names the file, the key and what it must be.
    """
    content, where = read_yaml(path), str(path)
    _require_keys(where, content, _TABLE_KEYS, {"label", "caption", "dataset", "metrics", "rows"})
    label = _require(where, content, "label", str)
    if label != path.stem:
        raise ValueError(
            f"{where}: label must be the file's name {path.stem}, got {visible(label)}"
        )
    if not is_label(label):
        raise ValueError(f"{where}: label must be letters, digits, dots and dashes, got {label!r}")
    printed = content.get("number")
    if printed is not None and (type(printed) is not int or printed < 1):
        raise ValueError(f"{where}: number must be a whole number from 1, got {briefly(printed)}")
    metrics = tuple(_require(where, content, "metrics", list, str))
    for metric in metrics:
        if metric not in QUANTITIES:
            raise ValueError(f"{where}: metrics must be of {', '.join(QUANTITIES)}, got {metric!r}")
    if not metrics:
        raise ValueError(f"{where}: metrics must be at least 1, got none")
    by = _require(where, content, "by", str)
    if by not in ("", "scene", "category"):
        raise ValueError(f"{where}: by must be scene or category, got {by!r}")
    by_category = by == "category"
    kinds = _require(where, content, "categories", dict, str)
    scenes = _require(where, content, "scenes", dict, str)
    columns = set(kinds) if by_category else {*scenes, AVERAGE}
    rows = tuple(
        _row(f"{where}: rows[{i}]", row, metrics, columns)
        for i, row in enumerate(_require(where, content, "rows", list, dict))
    )
    if not rows:
        raise ValueError(f"{where}: rows must be at least 1, got none")
    against = _require(where, content, "against", str)
    if against and against not in (labels := [row.label for row in rows]):
        raise ValueError(
            f"{where}: against must be a row's label ({', '.join(dict.fromkeys(labels))}), got {against!r}"
        )
    return Table(
        label=label,
        number=printed,
        caption=_require(where, content, "caption", str),
        dataset=_require(where, content, "dataset", str),
        scenes=scenes,
        metrics=metrics,
        rows=rows,
        by_category=by_category,
        kinds=kinds,
        seeds=tuple(_require(where, content, "seeds", list, int)),
        elsewhere=_require(where, content, "elsewhere", str),
        same_runs_as=_require(where, content, "same_runs_as", str),
        against=against,
        source=where,
    )


def _row(where: str, content: Any, metrics: tuple[str, ...], columns: set[str]) -> Row:
    _require_keys(where, content, _ROW_KEYS, {"label", "set"})
    overrides = _require(where, content, "set", list, str)
    paper: dict[str, dict[str, float]] = {}
    for column, value in _require(where, content, "paper", dict).items():
        if column not in columns:
            known = ", ".join(sorted(columns))
            raise ValueError(f"{where}: paper must have columns of {known}, got {briefly(column)}")
        values = value if isinstance(value, dict) else {metrics[0]: value}
        for metric, number in values.items():
            if metric not in metrics or not is_number(number):
                raise ValueError(
                    f"{where}: paper must give numbers for {', '.join(metrics)}, got {metric}: {briefly(number)}"
                )
        paper[column] = {metric: float(number) for metric, number in values.items()}
    label = content["label"]
    if not isinstance(label, str) and not is_number(label):
        raise ValueError(f"{where}: label must be a text, got {briefly(label)}")
    return Row(
        label=str(label),
        overrides=tuple(overrides),
        group=_require(where, content, "group", str),
        marks=_require(where, content, "marks", dict, bool),
        paper=paper,
        ours=_require(where, content, "ours", str),
    )


def read_yaml(path: Path) -> Any:
    """The content of a small YAML file.

    Raises:
        ValueError: If it is none; the file is named.
    """
    if path.exists() and not path.is_file():  # a pipe would be waited for without end
        raise ValueError(f"{path}: must be a file, got a folder or a device")
    content = path.read_bytes()
    try:
        if sum(map(content.count, (b"[", b"{", b"- -", b"? ?"))) > DEEPEST:
            _require_shallow(content)
        return _LOADER(content).get_single_data()
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: an impossible date
        raise ValueError(f"{path}: must be YAML, got: {error}") from error


def _require_shallow(content: bytes) -> None:
    """Refuse what the parser in C would overrun the stack with.

    Raises:
        ValueError: If lists and mappings lie too deep in each other.
    """
    depth = 0
    for event in yaml.parse(content, _LOADER):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise ValueError(f"more than {DEEPEST} lists and mappings in each other")


def briefly(content: Any) -> str:
    """A value for an error; a small file can hold a list that is very large in print."""
    if isinstance(content, (list, dict)):
        return f"a {type(content).__name__} of {len(content)}"
    text = repr(content)
    return text if len(text) <= 80 else f"{text[:80]}..."


def _require(
    where: str, content: dict[Any, Any], key: str, kind: type, inner: type | None = None
) -> Any:
    """An entry, or an empty one of its kind where there is none; `inner` is the kind of what it holds, keys are texts."""
    value = content.get(key, kind())
    if isinstance(value, kind):
        inside = value.values() if isinstance(value, dict) else value if inner else ()
        odd = [v for v in inside if inner and not isinstance(v, inner)]
        odd += [k for k in value if not isinstance(k, str)] if isinstance(value, dict) else []
        if not odd:
            return value
        value = odd[0]
    words = {str: "text", list: "list", dict: "mapping", bool: "true or false", int: "whole number"}
    of = f" of {words[inner]}" if inner else ""
    raise ValueError(f"{where}: {key} must be a {words[kind]}{of}, got {briefly(value)}")


def _require_keys(where: str, content: Any, allowed: set[str], needed: set[str]) -> None:
    if not isinstance(content, dict):
        raise ValueError(f"{where}: must be a mapping, got {briefly(content)}")
    for key in content:
        if not isinstance(key, str):
            raise ValueError(f"{where}: keys must be text, got {briefly(key)}")
    for key in sorted(needed - set(content)):
        raise ValueError(f"{where}: must have {key}, got keys {sorted(content)}")
    for key in sorted(set(content) - allowed):
        raise ValueError(f"{where}: must have no key but {sorted(allowed)}, got {key!r}")
