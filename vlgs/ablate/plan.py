"""Which runs the chosen tables need. Imports no torch and reads no data."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException, HydraException
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException

from vlgs.config import CONF, Identity, check_targets, identity
from vlgs.tables.registry import Table


@dataclass(frozen=True)
class Benchmark:
    """On what the rows of a table are run: `results/<name>/benchmark.yaml`, written once and committed with the tables."""

    name: str
    """Folder of the tables below `results`."""
    overrides: tuple[str, ...]
    """Hydra overrides of every run, e.g. ``data=synthetic``; a row's own come after them."""
    scenes: tuple[str, ...]
    """Values of `data.scene`; for a data set of one folder, the name of that folder."""
    seeds: tuple[int, ...]

    def __post_init__(self) -> None:
        for name, values in (("scenes", self.scenes), ("seeds", self.seeds)):
            if not values or len(set(values)) != len(values):
                raise ValueError(
                    f"ablate: {name} must be given, each once, got {', '.join(map(str, values)) or 'none'}"
                )
        if not self.name or Path(self.name).name != self.name:
            raise ValueError(f"ablate: name must be a folder's name, got {self.name!r}")

    def write(self, path: Path) -> None:
        """Say in a file what the tables beside it were run on; folders of this machine stay out of it."""
        content = {
            "overrides": [o for o in self.overrides if not _is_a_place(o)],
            "scenes": list(self.scenes),
            "seeds": list(self.seeds),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(content, sort_keys=False))

    @classmethod
    def read(cls, path: Path) -> "Benchmark":
        """The inverse of `write`, places apart.

        Raises:
            ValueError: Names the file and what it must hold.
        """
        content = yaml.safe_load(path.read_text())
        if not isinstance(content, dict) or set(content) != {"overrides", "scenes", "seeds"}:
            raise ValueError(f"{path}: must hold overrides, scenes and seeds, got {content!r}")
        return cls(
            path.parent.name,
            tuple(content["overrides"]),
            tuple(map(str, content["scenes"])),
            tuple(content["seeds"]),
        )


@dataclass(frozen=True)
class PlannedRun:
    """One run that at least one row needs."""

    overrides: tuple[str, ...]
    """Arguments of `python -m vlgs.run`."""
    identity: Identity
    scene: str
    wanted_by: tuple[str, ...]
    """Rows that it fills, as ``table: row``."""

    @property
    def key(self) -> tuple[Identity, str]:
        """What makes two runs one."""
        return self.identity, self.scene

    @property
    def name(self) -> str:
        """Short and unique; also the name of its log."""
        return f"{self.identity.recipe}-{self.scene}-{self.identity.seed}"


class Composer:
    """Row to identity; every distinct row is composed once.

    Raises:
        ValueError: From its methods, if an override is not one of the configuration's.
    """

    def __init__(self, benchmark: Benchmark) -> None:
        self.benchmark = benchmark
        self._configs: dict[tuple[str, ...], DictConfig] = {}

    def identity(self, overrides: Sequence[str], seed: int) -> Identity:
        """Recipe of a row on this benchmark."""
        config = self._composed(tuple(overrides))
        with open_dict(config):
            config.seed = seed
        return identity(config)

    def takes_scenes(self) -> bool:
        """Whether the data set holds several scenes (`data.scene`)."""
        return "scene" in self._composed(()).data

    def _composed(self, overrides: tuple[str, ...]) -> DictConfig:
        if overrides not in self._configs:
            with initialize_config_dir(str(CONF), version_base="1.3"):
                self._configs[overrides] = _compose([*self.benchmark.overrides, *overrides])
        return self._configs[overrides]


def plan(
    tables: Iterable[Table], benchmark: Benchmark, composer: Composer | None = None
) -> list[PlannedRun]:
    """The unique runs of the tables, in the order in which the tables name them, all rows of one seed before the next.

    Raises:
        ValueError: If a row names an option that does not exist; the table and the row are named.
    """
    composer = composer or Composer(benchmark)
    wanted: dict[tuple[Identity, str], tuple[tuple[str, ...], list[str]]] = {}
    for seed in benchmark.seeds:
        for table in tables:
            for row in table.runnable:
                assert row.overrides is not None
                title = f"{table.label}: {row.label}"
                try:
                    key = composer.identity(row.overrides, seed)
                except ValueError as error:
                    raise ValueError(f"{title}: {error}") from error
                for scene in benchmark.scenes:
                    command = _command(benchmark, row.overrides, scene, seed, composer)
                    rows = wanted.setdefault((key, scene), (command, []))[1]
                    if title not in rows:
                        rows.append(title)
    return [
        PlannedRun(command, key, scene, tuple(rows))
        for (key, scene), (command, rows) in wanted.items()
    ]


def _command(
    benchmark: Benchmark, row: tuple[str, ...], scene: str, seed: int, composer: Composer
) -> tuple[str, ...]:
    chosen = (f"data.scene={scene}",) if composer.takes_scenes() else ()
    return (*benchmark.overrides, *row, *chosen, f"seed={seed}")


def _compose(overrides: list[str]) -> DictConfig:
    try:
        config = compose("config", overrides=overrides)
        check_targets(config)
    except (ConfigCompositionException, OmegaConfBaseException, HydraException) as error:
        reason = str(error).strip().partition("\n")[0]
        raise ValueError(f"{' '.join(overrides) or 'the defaults'}: {reason}") from error
    return config


def _is_a_place(override: str) -> bool:
    key = override.partition("=")[0].lstrip("+")
    return key in {"data.root", "data.labels", "data.features", "data.vocabulary", "results"}


def find(runs: Sequence[Mapping[str, Any]]) -> dict[tuple[Identity, str], Mapping[str, Any]]:
    """Finished runs by `PlannedRun.key`.

    Args:
        runs: Contents of metrics.json files.

    Raises:
        ValueError: If two runs claim the same row, scene and seed: their data differ in content.
    """
    found: dict[tuple[Identity, str], Mapping[str, Any]] = {}
    for run in runs:
        if "recipe" not in run:
            continue  # from before runs said so
        key = Identity(run["recipe"], run["data_recipe"], run["seed"]), str(run["scene"])
        if key in found and found[key]["config_hash"] != run["config_hash"]:
            raise ValueError(
                f"results: runs of one row, scene {key[1]} and seed {key[0].seed} must be one, got "
                f"{found[key]['config_hash']} and {run['config_hash']}, whose data differ; remove one of the folders"
            )
        found[key] = run
    return found
