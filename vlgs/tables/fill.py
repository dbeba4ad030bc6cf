"""Computes the numbers of one table from runs: mean and deviation over seeds, beside the paper's value."""

import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import pandas as pd

from vlgs.config import split_override
from vlgs.tables.benchmark import Benchmark, Recipes, UnknownOptionError
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
    """Row -> recipe of its runs; without rows of which none is known."""
    same_scenes: bool
    """Whether the scenes are the paper's, so that its values can be set against ours."""
    cells: Mapping[Place, Cell]
    """Every place of the table, row by row."""
    numbers: Sequence[Number]
    """Every single number behind the cells."""
    runs: pd.DataFrame
    """One line of each run behind the cells, as `vlgs.tables.frame.tidy` has it."""
    results_version: int
    """Of those runs; 0 without any."""
    provenance: tuple[str, ...]
    """Machine, commit, protocol, seeds and data of those runs, as text."""


def fill(table: Table, benchmark: Benchmark, recipes: Recipes, frame: pd.DataFrame) -> Filled:
    """Look up the runs of every row.

    Args:
        table: What to fill.
        benchmark: Data, scenes and seeds.
        recipes: Of the same benchmark.
        frame: Of all runs, as `vlgs.tables.frame.tidy` has it.

    Raises:
        UnknownOptionError: If a row names an option that does not exist; the file and the row are named.
    """
    rows = _rows(table, benchmark, recipes)
    scenes, several = benchmark.scenes, len(set(benchmark.scenes)) > 1
    mine = frame[frame["recipe"].isin(rows["recipe"])]
    mine = mine[mine["scene"].isin(scenes) & mine["seed"].isin(table.chosen(benchmark.seeds))]
    found = rows.merge(mine, on=["recipe", "data_recipe"]).merge(_entries(table), on="metric")
    # Of fields without Gaussians earlier runs said 0, which would be the best count of all.
    known = (found["metric"] != "n_gaussians") | (found["value"] > 0)
    value = found["value"].where(known) * found["factor"]
    numbers = found.assign(value=value, metric=found["name"])
    if table.by_category:
        numbers = _of_categories(table, numbers, several).dropna(subset="value")
        numbers = pd.concat([numbers, _kind_means(numbers)])
        columns = _category_columns(table, numbers)
    else:
        numbers = numbers.assign(column=numbers["scene"]).dropna(subset="value")
        numbers = pd.concat([numbers, _averages(numbers, len(scenes))])
        columns = dict.fromkeys((*scenes, AVERAGE) if several else scenes, "")
    dataset = dict(map(split_override, benchmark.overrides)).get("data", "synthetic")
    same = dataset == table.dataset and set(scenes) <= set(table.scenes.values())
    runs = found.drop_duplicates("config_hash")[list(frame.columns)]
    return Filled(
        table=table,
        benchmark=benchmark,
        columns=tuple(columns),
        kinds={column: kind for column, kind in columns.items() if kind},
        recipes={
            row: recipe for row, recipe in zip(rows["row"], rows["recipe"], strict=True) if recipe
        },
        same_scenes=same,
        cells=dict(_cells(table, tuple(columns), numbers, same)),
        numbers=[Number(*each) for each in numbers[list(Number._fields)].itertuples(index=False)],
        runs=runs,
        results_version=int(runs["results_version"].max()) if len(runs) else 0,
        provenance=_provenance(table, benchmark, runs),
    )


def printed_name(category: str) -> str:
    """A category as the paper spells it.

    Example:
        >>> printed_name("sake cup")
        'sake_cup'
    """
    return category.replace(" ", "_")


def _rows(table: Table, benchmark: Benchmark, recipes: Recipes) -> pd.DataFrame:
    """Number, recipe and data recipe of every row."""
    rows = []
    for index, row in enumerate(table.rows):
        try:
            wanted = recipes.identity(row.overrides, benchmark.seeds[0])
        except UnknownOptionError as error:
            where = f"{table.source}: rows[{index}].set"
            raise UnknownOptionError(
                f"{where} must be options of the configuration, got {error}"
            ) from error
        rows.append((index, wanted.recipe, wanted.data))
    return pd.DataFrame(rows, columns=["row", "recipe", "data_recipe"])


def _entries(table: Table) -> pd.DataFrame:
    """Which entry of a run is which quantity of the table, and by what it is multiplied."""
    quantities = [(name, QUANTITIES[name]) for name in table.metrics]
    entries = [
        ("per_category" if table.by_category else q.entry, name, q.factor) for name, q in quantities
    ]
    return pd.DataFrame(entries, columns=["metric", "name", "factor"])


def _of_categories(table: Table, numbers: pd.DataFrame, several: bool) -> pd.DataFrame:
    """The categories as columns, those of several scenes with the scene's name, and of the kinds of the table where it has one alone."""
    printed = numbers["category"].map(printed_name)
    kind = numbers["kind"].where(numbers["kind"] != "", printed.map(table.kinds).fillna(""))
    column = numbers["scene"] + ": " + numbers["category"] if several else numbers["category"]
    numbers, only = numbers.assign(kind=kind, column=column), set(table.kinds.values())
    return numbers[kind.isin(only)] if len(only) == 1 else numbers


def _kind_means(numbers: pd.DataFrame) -> pd.DataFrame:
    """Mean over the categories of a kind per seed, where every category has a number; kinds of one category have none."""
    means = _means(numbers[numbers["kind"] != ""], ["row", "kind", "metric", "seed"])
    wanted = means["kind"].map(numbers.groupby("kind")["column"].nunique())
    means = means[(means["count"] == wanted) & (wanted > 1)]
    return means.assign(column=MEAN + means["kind"])


def _averages(numbers: pd.DataFrame, scenes: int) -> pd.DataFrame:
    """Mean over scenes per seed, where every scene has a number."""
    means = _means(numbers, ["row", "metric", "seed"])
    return means[means["count"] == scenes].assign(column=AVERAGE, kind="")


def _means(numbers: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    groups = numbers.groupby(by, sort=False)["value"]
    return groups.agg(value="mean", count="count").reset_index()


def _category_columns(table: Table, numbers: pd.DataFrame) -> dict[str, str]:
    """Category -> kind, kinds together and the mean of each last; the paper's categories where there is no run."""
    if numbers.empty:
        return dict(table.kinds)
    pairs = set(zip(numbers["column"], numbers["kind"], strict=True))
    return dict(sorted(pairs, key=lambda pair: (pair[1], pair[0].startswith(MEAN), pair[0])))


def _cells(
    table: Table, columns: Sequence[str], numbers: pd.DataFrame, same: bool
) -> Iterator[tuple[Place, Cell]]:
    names = {scene: paper for paper, scene in table.scenes.items()} | {AVERAGE: AVERAGE}
    groups = numbers.groupby(list(Place._fields))["value"].agg(["mean", "std", "count"])
    spread = dict(zip(groups.index, groups.itertuples(index=False, name=None), strict=True))
    ordered = set() if same else _ordered(table, set(spread))
    for place in itertools.starmap(
        Place, itertools.product(range(len(table.rows)), columns, table.metrics)
    ):
        mean, std, seeds = spread.get(place, (math.nan, math.nan, 0))
        row, column = table.rows[place.row], place.column
        printed = printed_name(column) if table.by_category else names.get(column, "")
        known = same or (column == AVERAGE and (row.group, place.metric) in ordered)
        theirs = row.paper.get(printed, {}).get(place.metric, math.nan) if known else math.nan
        yield place, Cell(mean, std, seeds, theirs, mean - theirs if same else math.nan)


def _ordered(table: Table, filled: Collection[tuple[int, str, str]]) -> set[tuple[str, str]]:
    """Groups and metrics of which two different rows have an average of ours and of the paper, so that their order can be compared."""
    rows: dict[tuple[str, str], set[tuple[str, ...]]] = {}
    for (index, row), metric in itertools.product(enumerate(table.rows), table.metrics):
        if metric in row.paper.get(AVERAGE, {}) and (index, AVERAGE, metric) in filled:
            rows.setdefault((row.group, metric), set()).add(row.overrides)
    return {place for place, different in rows.items() if len(different) > 1}


def _provenance(table: Table, benchmark: Benchmark, runs: pd.DataFrame) -> tuple[str, ...]:
    def all_of(column: str) -> str:
        values = runs[column].dropna().unique()
        return (
            ", ".join(sorted(str(int(v)) if isinstance(v, float) else str(v) for v in values))
            or "--"
        )

    return (
        f"data: {' '.join(benchmark.overrides)}; scenes {', '.join(benchmark.scenes)}; "
        f"seeds {', '.join(map(str, table.chosen(benchmark.seeds)))}",
        f"runs: {len(runs)}; protocol {all_of('protocol')}; results version {all_of('results_version')}",
        f"commit: {all_of('commit')}; machine: {all_of('cpu')}; instruction set: {all_of('isa')}; threads: {all_of('threads')}",
    )
