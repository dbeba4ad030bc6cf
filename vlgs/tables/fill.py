"""From runs to the numbers of one table: mean and deviation over seeds beside the paper's value."""

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from vlgs.config import split_override
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import AVERAGE, Table

LONG = {"row": int, "column": str, "kind": str, "metric": str, "seed": int, "value": float}
"""Columns of `Filled.values`."""
CELL_COLUMNS = (
    "row",
    "group",
    "label",
    "column",
    "metric",
    "mean",
    "std",
    "seeds",
    "paper",
    "difference",
)


MEAN = "mean of "
"""Before the kind, in the column of the mean over the categories of a kind."""


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
    cells: pd.DataFrame
    """`CELL_COLUMNS`, in printed units; no value is NaN. ``std`` is over seeds, with n - 1."""
    values: pd.DataFrame
    """Every single number behind the cells: row, column, kind, metric, seed, value."""
    runs: pd.DataFrame
    """The runs behind the cells, one line each: config_hash, protocol, commit, cpu, results_version."""


def fill(table: Table, benchmark: Benchmark, composer: Composer, frame: pd.DataFrame) -> Filled:
    """Look up the runs of every row.

    Args:
        table: What to fill.
        benchmark: Data, scenes and seeds.
        composer: Of the same benchmark.
        frame: As `vlgs.tables.frame.tidy` returns it.

    Raises:
        ValueError: If a row names an option that does not exist.
    """
    entries = {QUANTITIES[name].entry for name in table.metrics}
    frame = frame[
        frame["metric"].isin({"per_category"} if table.by_category else entries)
        & frame["scene"].isin(benchmark.scenes)
        & frame["seed"].isin(benchmark.seeds)
    ]
    places = frame.groupby(["recipe", "data_recipe"]).indices
    values, hashes, recipes = [], set[str](), dict[int, str]()
    for index, row in enumerate(table.rows):
        if row.overrides is None:
            continue
        wanted = composer.identity(row.overrides, benchmark.seeds[0])
        recipes[index] = wanted.recipe
        found = frame.iloc[places.get((wanted.recipe, wanted.data), [])]
        hashes |= set(found["config_hash"])
        values.extend(_values(index, table, found, several=len(benchmark.scenes) > 1))
    long = pd.DataFrame(values, columns=list(LONG)).astype(LONG)
    if table.by_category:
        long = pd.concat([long, _kind_means(long)])
        columns = _category_columns(table, long)
    else:
        long = pd.concat([long, _averages(long, benchmark.scenes)])
        several = len(benchmark.scenes) > 1
        columns = dict.fromkeys((*benchmark.scenes, AVERAGE) if several else benchmark.scenes, "")
    dataset = dict(map(split_override, benchmark.overrides)).get("data", "synthetic")
    same = dataset == table.dataset and set(benchmark.scenes) <= set(table.scenes.values())
    cells = pd.DataFrame(_cells(table, tuple(columns), long, same), columns=pd.Index(CELL_COLUMNS))
    runs = frame[frame["config_hash"].isin(hashes)].drop_duplicates("config_hash")
    kinds = {c: k for c, k in columns.items() if k}
    long = long.reset_index(drop=True)
    return Filled(table, benchmark, tuple(columns), kinds, recipes, same, cells, long, runs)


def _values(
    index: int, table: Table, found: pd.DataFrame, several: bool
) -> Iterator[tuple[int, str, str, str, int, float]]:
    """Numbers of one row in printed units, as `LONG`; categories of several scenes carry the scene's name.

    Plain loops: of frames this small pandas would take most of the time that all tables take.
    """
    only = set(table.kinds.values())
    names = ("scene", "category", "kind", "metric", "seed", "value")
    numbers = list(zip(*(found[name].tolist() for name in names), strict=True))
    for name in table.metrics:
        quantity = QUANTITIES[name]
        entry = "per_category" if table.by_category else quantity.entry
        for scene, category, kind, metric, seed, value in numbers:
            if metric != entry or math.isnan(value):
                continue
            column = scene
            if table.by_category:
                kind = kind or table.kinds.get(printed_name(category), "")
                column = f"{scene}: {category}" if several else category
            if len(only) != 1 or kind in only:
                yield index, column, kind, name, seed, value * quantity.factor


def printed_name(category: str) -> str:
    """A category as the paper spells it.

    Example:
        >>> printed_name("sake cup")
        'sake_cup'
    """
    return category.replace(" ", "_")


def _kind_means(long: pd.DataFrame) -> pd.DataFrame:
    """Mean over the categories of a kind per seed, where every category has a number; kinds of one category have none."""
    sizes = long.groupby("kind")["column"].nunique()
    grouped = long.groupby(["row", "kind", "metric", "seed"])["value"]
    means = grouped.agg(value="mean", size="count").reset_index()
    needed = means["kind"].map(sizes)
    means = means[(means["size"] == needed) & (needed > 1) & (means["kind"] != "")]
    return means.drop(columns="size").assign(column=lambda part: MEAN + part["kind"])


def _category_columns(table: Table, long: pd.DataFrame) -> dict[str, str]:
    """Category -> kind, kinds together and the mean of each last; the paper's categories where there is no run."""
    if long.empty:
        return dict(table.kinds)
    pairs = set(zip(long["column"], long["kind"], strict=True))
    ordered = sorted(pairs, key=lambda pair: (pair[1], pair[0].startswith(MEAN), pair[0]))
    return dict(ordered)


def _averages(long: pd.DataFrame, scenes: Sequence[str]) -> pd.DataFrame:
    """Mean over scenes per seed, where every scene has a number."""
    grouped = long.groupby(["row", "metric", "seed"])["value"]
    averages = grouped.agg(value="mean", scenes="count").reset_index()
    complete = averages[averages["scenes"] == len(scenes)].drop(columns="scenes")
    return complete.assign(column=AVERAGE)


def _cells(
    table: Table, columns: Sequence[str], long: pd.DataFrame, same: bool
) -> Iterator[tuple[object, ...]]:
    names = {scene: paper for paper, scene in table.scenes.items()} | {AVERAGE: AVERAGE}
    groups: dict[tuple[int, str, str], list[float]] = {}
    for *key, value in zip(long["row"], long["column"], long["metric"], long["value"], strict=True):
        groups.setdefault((key[0], key[1], key[2]), []).append(value)
    for index, row in enumerate(table.rows):
        for column in columns:
            for metric in table.metrics:
                numbers = groups.get((index, column, metric), [])
                mean = statistics.fmean(numbers) if numbers else math.nan
                std = statistics.stdev(numbers) if len(numbers) > 1 else math.nan
                paper = math.nan
                if same:
                    printed = printed_name(column) if table.by_category else names.get(column, "")
                    paper = row.paper.get(printed, {}).get(metric, math.nan)
                elif column == AVERAGE:
                    paper = row.paper.get(AVERAGE, {}).get(metric, math.nan)
                difference = mean - paper if same else math.nan
                yield (
                    index, row.group, row.label, column, metric, mean, std, len(numbers), paper, difference,
                )  # fmt: skip
