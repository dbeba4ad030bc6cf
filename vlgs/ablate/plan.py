"""Which runs the chosen tables need. Reads no data."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vlgs.config import quote_override
from vlgs.identity import RunIdentity
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.registry import Table

RunKey = tuple[RunIdentity, str]
"""What makes two runs one: the identity, and the scene."""


@dataclass(frozen=True)
class PlannedRun:
    """One run that at least one row needs."""

    overrides: tuple[str, ...]
    """Arguments of `python -m vlgs.run`."""
    identity: RunIdentity
    scene: str
    wanted_by: tuple[str, ...]
    """Rows that it fills, as ``table: row``."""

    @property
    def key(self) -> RunKey:
        """What makes two runs one."""
        return self.identity, self.scene

    @property
    def name(self) -> str:
        """Short and unique; also the name of its log."""
        return f"{self.identity.recipe}-{self.scene}-{self.identity.seed}"


def plan(
    tables: Iterable[Table], benchmark: Benchmark, composer: Composer | None = None
) -> list[PlannedRun]:
    """The unique runs of the tables, in the order in which the tables name them, all rows of one seed before the next.

    Raises:
        ValueError: If a row names an option that does not exist; the table and the row are named.
    """
    composer = composer or Composer(benchmark)
    by_scene = composer.takes_scenes()
    wanted: dict[RunKey, tuple[tuple[str, ...], list[str]]] = {}
    for seed in benchmark.seeds:
        for table in tables:
            if seed not in table.chosen(benchmark.seeds):
                continue
            for row in table.rows:
                assert row.overrides is not None
                title = f"{table.label}: {row.label}"
                try:
                    key = composer.identity(row.overrides, seed)
                except ValueError as error:
                    raise ValueError(f"{table.source}: {title}: {error}") from error
                for scene in benchmark.scenes:
                    chosen = (quote_override("data.scene", scene),) if by_scene else ()
                    command = (*benchmark.overrides, *row.overrides, *chosen, f"seed={seed}")
                    rows = wanted.setdefault((key, scene), (command, []))[1]
                    if title not in rows:
                        rows.append(title)
    return [
        PlannedRun(command, key, scene, tuple(rows))
        for (key, scene), (command, rows) in wanted.items()
    ]


def find(runs: Sequence[Mapping[str, Any]]) -> dict[RunKey, Mapping[str, Any]]:
    """Finished runs by `PlannedRun.key`.

    Args:
        runs: Contents of metrics.json files.

    Raises:
        ValueError: If two runs claim the same row, scene and seed: their data differ in content.
    """
    found: dict[RunKey, Mapping[str, Any]] = {}
    for run in runs:
        if "recipe" not in run:
            continue  # from before runs said so
        key = RunIdentity(run["recipe"], run["data_recipe"], run["seed"]), str(run["scene"])
        if key in found and found[key]["config_hash"] != run["config_hash"]:
            raise ValueError(
                f"results: runs of one row, scene {key[1]} and seed {key[0].seed} must be one, got "
                f"{found[key]['config_hash']} and {run['config_hash']}, whose data differ; remove one of the folders"
            )
        found[key] = run
    return found
