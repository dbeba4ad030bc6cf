"""Finished runs as one tidy frame: a row per run, metric and category."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from vlgs.files import write_atomically

RUN_COLUMNS = (
    "config_hash",
    "recipe",
    "data_recipe",
    "dataset",
    "scene",
    "seed",
    "protocol",
    "results_version",
    "commit",
)
"""What is the same in all rows of a run, as in metrics.json."""

COLUMNS = (*RUN_COLUMNS, "cpu", "metric", "category", "kind", "value")

DETAILS = {"per_category", "category_kinds", "indicator", "per_view", "reasons", "machine", "skips"}
"""Entries of metrics.json that are not one value."""


def read_metrics(results: Path) -> list[dict[str, Any]]:
    """Contents of metrics.json of every finished run below `results`/runs.

    Raises:
        ValueError: If a file is not JSON; it is named.
    """
    runs = []
    for path in sorted((results / "runs").glob("*/metrics.json")):
        try:
            runs.append(json.loads(path.read_text()))
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}: must be JSON, got: {error}") from error
    return runs


def tidy(runs: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """One row per run, metric and category; a metric that could not be computed has no value (NaN).

    Args:
        runs: Contents of metrics.json files; those from before runs said which row they fill are left out.
    """
    rows = []
    for run in runs:
        if "recipe" not in run:
            continue
        shared = [run.get(name) for name in RUN_COLUMNS] + [(run.get("machine") or {}).get("cpu")]
        for metric, value in run.items():
            if metric in RUN_COLUMNS or metric in DETAILS or isinstance(value, (str, dict, list)):
                continue
            rows.append([*shared, metric, "", "", value])
        kinds = run.get("category_kinds") or {}
        for category, value in (run.get("per_category") or {}).items():
            rows.append([*shared, "per_category", category, kinds.get(category, ""), value])
    frame = pd.DataFrame(rows, columns=list(COLUMNS))
    frame["value"] = pd.to_numeric(frame["value"], errors="coerce")
    frame["scene"] = frame["scene"].astype(str)
    return frame


def write_frame(frame: pd.DataFrame, results: Path) -> None:
    """Write runs.csv, and runs.parquet where pyarrow is installed."""
    write_atomically(results / "runs.csv", frame.to_csv(index=False).encode())
    try:
        parquet = frame.to_parquet(index=False)
    except ImportError:
        return
    assert parquet is not None
    write_atomically(results / "runs.parquet", parquet)


def require_one_meaning(frame: pd.DataFrame) -> None:
    """Refuse what must not stand in one table.

    Raises:
        ValueError: If two runs claim one recipe, data, scene and seed, or runs of one data set differ in protocol.
    """
    runs = frame.drop_duplicates("config_hash")
    same = runs[runs.duplicated(["recipe", "data_recipe", "scene", "seed"], keep=False)]
    if len(same):
        first = same.iloc[0]
        twins = same[
            (
                same[["recipe", "data_recipe", "scene", "seed"]]
                == first[["recipe", "data_recipe", "scene", "seed"]]
            ).all(axis=1)
        ]
        raise ValueError(
            f"results: runs of one row, scene {first['scene']} and seed {first['seed']} must be one, got "
            f"{', '.join(twins['config_hash'])}, whose data differ; remove all but one of the folders"
        )
    for (recipe, data), group in runs.groupby(["recipe", "data_recipe"]):
        protocols = sorted(set(group["protocol"].dropna()))
        if len(protocols) > 1:
            raise ValueError(
                f"results: runs of recipe {recipe} on data {data} must share a protocol, got {', '.join(protocols)}"
            )
