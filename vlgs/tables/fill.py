"""From runs to the numbers of one table: mean and deviation over seeds beside the paper's value."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import pandas as pd

from vlgs.config import split_override
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import AVERAGE, Row, Table

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


@dataclass(frozen=True)
class Filled:
    """A table with its numbers."""

    table: Table
    benchmark: Benchmark
    columns: tuple[str, ...]
    """Scenes and ``avg``, or categories."""
    same_scenes: bool
    """Whether the scenes are the paper's, so that its values can be set against ours."""
    cells: pd.DataFrame
    """`CELL_COLUMNS`, in printed units; no value is NaN. ``std`` is over seeds, with n - 1."""
    values: pd.DataFrame
    """Every single number behind the cells: row, column, metric, seed, value."""
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
    values, hashes = [], set()
    for index, row in enumerate(table.rows):
        if row.overrides is None:
            continue
        found = _runs_of(row, benchmark, composer, frame)
        hashes |= set(found["config_hash"])
        values.append(_values(index, table, found, several=len(benchmark.scenes) > 1))
    long = pd.concat(values) if values else _values(0, table, frame.iloc[:0], several=False)
    columns = _columns(table, benchmark, long)
    if not table.by_category:
        long = pd.concat([long, _averages(long, benchmark.scenes)])
    dataset = dict(map(split_override, benchmark.overrides)).get("data", "synthetic")
    same = dataset == table.dataset and set(benchmark.scenes) <= set(table.scenes.values())
    cells = pd.DataFrame(_cells(table, columns, long, same), columns=pd.Index(CELL_COLUMNS))
    runs = frame[frame["config_hash"].isin(hashes)].drop_duplicates("config_hash")
    return Filled(table, benchmark, columns, same, cells, long.reset_index(drop=True), runs)


def _runs_of(
    row: Row, benchmark: Benchmark, composer: Composer, frame: pd.DataFrame
) -> pd.DataFrame:
    assert row.overrides is not None
    wanted = composer.identity(row.overrides, benchmark.seeds[0])
    return frame[
        (frame["recipe"] == wanted.recipe)
        & (frame["data_recipe"] == wanted.data)
        & frame["scene"].isin(benchmark.scenes)
        & frame["seed"].isin(benchmark.seeds)
    ]


def _values(index: int, table: Table, found: pd.DataFrame, several: bool) -> pd.DataFrame:
    """Numbers of one row in printed units; categories of several scenes carry the scene's name."""
    parts = []
    for name in table.metrics:
        quantity = QUANTITIES[name]
        entry = "per_category" if table.by_category else quantity.entry
        rows = found[found["metric"] == entry]
        part = pd.DataFrame(
            {
                "row": index,
                "column": _column_names(rows, table, several),
                "metric": name,
                "seed": rows["seed"],
                "value": rows["value"] * quantity.factor,
            }
        )
        parts.append(part)
    return pd.concat(parts)


def _column_names(rows: pd.DataFrame, table: Table, several: bool) -> pd.Series:
    if not table.by_category:
        return rows["scene"]
    return rows["scene"] + ": " + rows["category"] if several else rows["category"]


def _averages(long: pd.DataFrame, scenes: Sequence[str]) -> pd.DataFrame:
    """Mean over scenes per seed, where every scene has a number."""
    grouped = long.groupby(["row", "metric", "seed"])["value"]
    averages = grouped.agg(value="mean", scenes="count").reset_index()
    complete = averages[averages["scenes"] == len(scenes)].drop(columns="scenes")
    return complete.assign(column=AVERAGE)


def _columns(table: Table, benchmark: Benchmark, long: pd.DataFrame) -> tuple[str, ...]:
    if table.by_category:
        own = tuple(sorted(set(long["column"])))
        return own or tuple(table.kinds)
    return (*benchmark.scenes, AVERAGE) if len(benchmark.scenes) > 1 else benchmark.scenes


def _cells(
    table: Table, columns: Sequence[str], long: pd.DataFrame, same: bool
) -> Iterator[tuple[object, ...]]:
    names = {scene: paper for paper, scene in table.scenes.items()} | {AVERAGE: AVERAGE}
    groups = {key: part for key, part in long.groupby(["row", "column", "metric"])["value"]}
    for index, row in enumerate(table.rows):
        for column in columns:
            for metric in table.metrics:
                numbers = groups.get((index, column, metric), pd.Series(dtype=float)).dropna()
                mean = numbers.mean() if len(numbers) else math.nan
                std = numbers.std(ddof=1) if len(numbers) > 1 else math.nan
                paper = math.nan
                if same:
                    printed = column if table.by_category else names.get(column, "")
                    paper = row.paper.get(printed, {}).get(metric, math.nan)
                elif column == AVERAGE:
                    paper = row.paper.get(AVERAGE, {}).get(metric, math.nan)
                difference = mean - paper if same else math.nan
                yield (
                    index, row.group, row.label, column, metric, mean, std, len(numbers), paper, difference,
                )  # fmt: skip
