"""Computes the numbers of one table from runs: mean and deviation over seeds, beside the paper's value.

Plain loops, because pandas is slow on frames as small as those of one table.
"""

import math
import statistics
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from vlgs.config import split_override
from vlgs.tables.benchmark import Benchmark, Composer, UnknownOptionError
from vlgs.tables.frame import Line, Lines
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import AVERAGE, Table

MEAN = "mean of "
"""Prefix of the column with the mean over the categories of a kind."""


class Number(NamedTuple):
    """One number of one run, in printed units; never NaN."""

    row: int
    column: str
    kind: str
    """Of a category, "" otherwise."""
    metric: str
    seed: int
    value: float


class Place(NamedTuple):
    """Where a cell stands."""

    row: int
    column: str
    metric: str


class Cell(NamedTuple):
    """What stands there, in printed units; NaN where there is nothing."""

    mean: float
    std: float
    """Over seeds, with n - 1."""
    seeds: int
    paper: float
    difference: float
    """Mean minus the paper's, where the scenes are the paper's."""


@dataclass(frozen=True)
class Filled:
    """A table with its numbers."""

    table: Table
    benchmark: Benchmark
    columns: tuple[str, ...]
    """Scenes and ``avg``; or categories, each kind followed by its mean."""
    kinds: Mapping[str, str]
    """Category column -> kind; empty for a table by scene."""
    recipes: Mapping[int, str]
    """Row -> recipe of its runs, for rows that can be run."""
    same_scenes: bool
    """Whether the scenes are the paper's, so that its values can be set against ours."""
    cells: Mapping[Place, Cell]
    """Every place of the table, row by row."""
    numbers: Sequence[Number]
    """Every single number behind the cells."""
    runs: Sequence[Line]
    """One line of each run behind the cells."""
    provenance: tuple[str, ...]
    """Machine, commit, protocol, seeds and data of those runs, as text."""


def fill(table: Table, benchmark: Benchmark, composer: Composer, lines: Lines) -> Filled:
    """Look up the runs of every row.

    Args:
        table: What to fill.
        benchmark: Data, scenes and seeds.
        composer: Of the same benchmark.
        lines: Of all runs.

    Raises:
        UnknownOptionError: If a row names an option that does not exist; the file and the row are named.
    """
    entries = {QUANTITIES[name].entry for name in table.metrics}
    entries = {"per_category"} if table.by_category else entries
    scenes, seeds = set(benchmark.scenes), set(benchmark.seeds)
    numbers: list[Number] = []
    runs: dict[str, Line] = {}
    recipes: dict[int, str] = {}
    for index, row in enumerate(table.rows):
        if row.overrides is None:
            continue
        try:
            wanted = composer.identity(row.overrides, benchmark.seeds[0])
        except UnknownOptionError as error:
            where = f"{table.source}: rows[{index}].set"
            raise UnknownOptionError(
                f"{where} must be options of the configuration, got {error}"
            ) from error
        recipes[index] = wanted.recipe
        found = [
            line
            for line in lines.get((wanted.recipe, wanted.data), ())
            if line.metric in entries and line.scene in scenes and line.seed in seeds
        ]
        runs |= {line.config_hash: line for line in found}
        numbers.extend(_numbers(index, table, found, several=len(scenes) > 1))
    if table.by_category:
        numbers.extend(_kind_means(numbers))
        columns = _category_columns(table, numbers)
    else:
        numbers.extend(_averages(numbers, benchmark.scenes))
        named = (*benchmark.scenes, AVERAGE) if len(scenes) > 1 else benchmark.scenes
        columns = dict.fromkeys(named, "")
    dataset = dict(map(split_override, benchmark.overrides)).get("data", "synthetic")
    same = dataset == table.dataset and scenes <= set(table.scenes.values())
    return Filled(
        table=table,
        benchmark=benchmark,
        columns=tuple(columns),
        kinds={column: kind for column, kind in columns.items() if kind},
        recipes=recipes,
        same_scenes=same,
        cells=dict(_cells(table, tuple(columns), numbers, same)),
        numbers=numbers,
        runs=tuple(runs.values()),
        provenance=_provenance(benchmark, runs.values()),
    )


def printed_name(category: str) -> str:
    """A category as the paper spells it.

    Example:
        >>> printed_name("sake cup")
        'sake_cup'
    """
    return category.replace(" ", "_")


def _numbers(index: int, table: Table, found: Sequence[Line], several: bool) -> Iterator[Number]:
    """Numbers of one row; categories of several scenes carry the scene's name."""
    only = set(table.kinds.values())
    for name in table.metrics:
        quantity = QUANTITIES[name]
        entry = "per_category" if table.by_category else quantity.entry
        for line in found:
            if line.metric != entry or math.isnan(line.value):
                continue
            column, kind = line.scene, line.kind
            if table.by_category:
                kind = kind or table.kinds.get(printed_name(line.category), "")
                column = f"{line.scene}: {line.category}" if several else line.category
            if len(only) != 1 or kind in only:
                yield Number(index, column, kind, name, line.seed, line.value * quantity.factor)


def _kind_means(numbers: Sequence[Number]) -> list[Number]:
    """Mean over the categories of a kind per seed, where every category has a number; kinds of one category have none."""
    columns: dict[str, set[str]] = {}
    groups: dict[tuple[int, str, str, int], list[float]] = {}
    for number in numbers:
        columns.setdefault(number.kind, set()).add(number.column)
        key = (number.row, number.kind, number.metric, number.seed)
        groups.setdefault(key, []).append(number.value)
    return [
        Number(row, MEAN + kind, kind, metric, seed, statistics.fmean(values))
        for (row, kind, metric, seed), values in groups.items()
        if kind and len(values) == len(columns[kind]) > 1
    ]


def _category_columns(table: Table, numbers: Sequence[Number]) -> dict[str, str]:
    """Category -> kind, kinds together and the mean of each last; the paper's categories where there is no run."""
    if not numbers:
        return dict(table.kinds)
    pairs = {(number.column, number.kind) for number in numbers}
    return dict(sorted(pairs, key=lambda pair: (pair[1], pair[0].startswith(MEAN), pair[0])))


def _averages(numbers: Sequence[Number], scenes: Sequence[str]) -> list[Number]:
    """Mean over scenes per seed, where every scene has a number."""
    groups: dict[tuple[int, str, int], list[float]] = {}
    for number in numbers:
        groups.setdefault((number.row, number.metric, number.seed), []).append(number.value)
    return [
        Number(row, AVERAGE, "", metric, seed, statistics.fmean(values))
        for (row, metric, seed), values in groups.items()
        if len(values) == len(scenes)
    ]


def _cells(
    table: Table, columns: Sequence[str], numbers: Sequence[Number], same: bool
) -> Iterator[tuple[Place, Cell]]:
    names = {scene: paper for paper, scene in table.scenes.items()} | {AVERAGE: AVERAGE}
    groups: dict[Place, list[float]] = {}
    for number in numbers:
        place = Place(number.row, number.column, number.metric)
        groups.setdefault(place, []).append(number.value)
    for index, row in enumerate(table.rows):
        for column in columns:
            for metric in table.metrics:
                place = Place(index, column, metric)
                mean, std, seeds = _spread(groups.get(place, []))
                paper = math.nan
                if same:
                    printed = printed_name(column) if table.by_category else names.get(column, "")
                    paper = row.paper.get(printed, {}).get(metric, math.nan)
                elif column == AVERAGE:
                    paper = row.paper.get(AVERAGE, {}).get(metric, math.nan)
                difference = mean - paper if same else math.nan
                yield place, Cell(mean, std, seeds, paper, difference)


def _spread(values: Sequence[float]) -> tuple[float, float, int]:
    """Mean, deviation with n - 1, and how many."""
    if not values:
        return math.nan, math.nan, 0
    mean = statistics.fmean(values)
    if len(values) == 1:
        return mean, math.nan, 1
    squares = math.fsum((value - mean) ** 2 for value in values)
    return mean, math.sqrt(squares / (len(values) - 1)), len(values)


def _provenance(benchmark: Benchmark, runs: Collection[Line]) -> tuple[str, ...]:
    def all_of(column: str) -> str:
        return (
            ", ".join(sorted({str(v) for r in runs if (v := getattr(r, column)) is not None}))
            or "--"
        )

    return (
        f"data: {' '.join(benchmark.overrides)}; scenes {', '.join(benchmark.scenes)}; "
        f"seeds {', '.join(map(str, benchmark.seeds))}",
        f"runs: {len(runs)}; protocol {all_of('protocol')}; results version {all_of('results_version')}",
        f"commit: {all_of('commit')}; machine: {all_of('cpu')}",
    )
