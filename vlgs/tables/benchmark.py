"""The data, scenes and seeds behind the tables of one results folder, and the run that belongs to each row. Imports no torch."""

import hashlib
import json
import logging
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import yaml
from omegaconf import DictConfig, OmegaConf

from vlgs.config import CONF
from vlgs.files import write_atomically, write_changed
from vlgs.identity import (
    AS_WITHOUT,
    MOVES_NOTHING,
    PLACES,
    RESULTS_VERSION,
    SAID_ELSEWHERE,
    RunIdentity,
    identity,
    moves,
)
from vlgs.tables.registry import briefly, read_yaml

log = logging.getLogger(__name__)


class UnknownOptionError(ValueError):
    """A row has an option that the configuration of a benchmark does not have."""


@dataclass(frozen=True)
class Benchmark:
    """Data, scenes and seeds that every row of a table is run with: `results/<name>/benchmark.yaml`, committed with the tables."""

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
        if (
            Path(self.name).name != self.name
            or self.name in ("", "..")
            or not self.name.isprintable()
        ):
            raise ValueError(f"ablate: name must be a folder's name, got {self.name!r}")

    @property
    def recorded(self) -> tuple[str, ...]:
        """The overrides that can move a number: without folders of this machine, threads, pictures and the like."""
        return tuple(o for o in self.overrides if _moves(o))

    def extend(self, path: Path) -> "Benchmark":
        """Write the benchmark to a file beside its tables, or add its scenes and seeds to that file.

        Returns:
            What the file says now.

        Raises:
            ValueError: If the tables beside it are run on something else.
        """
        merged = Benchmark(self.name, self.recorded, self.scenes, self.seeds)
        if path.is_file():
            there = Benchmark.read(path)
            if there.overrides != merged.overrides:
                raise ValueError(
                    f"ablate: name must be new for other overrides, got name={self.name}, whose tables are run with "
                    f"{' '.join(there.overrides)}, not {' '.join(merged.overrides)} ({path})"
                )
            scenes = tuple(dict.fromkeys((*there.scenes, *merged.scenes)))
            seeds = tuple(sorted({*there.seeds, *merged.seeds}))
            merged = Benchmark(self.name, merged.overrides, scenes, seeds)
        content = {
            "overrides": list(merged.overrides),
            "scenes": list(merged.scenes),
            "seeds": list(merged.seeds),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, yaml.safe_dump(content, sort_keys=False).encode())
        return merged

    @classmethod
    def read(cls, path: Path) -> "Benchmark":
        """The inverse of `extend`.

        Raises:
            ValueError: Names the file and what it must hold.
        """
        content = read_yaml(path)
        if not isinstance(content, dict) or set(content) != {"overrides", "scenes", "seeds"}:
            raise ValueError(
                f"{path}: must hold overrides, scenes and seeds, got {briefly(content)}"
            )
        for key, kinds in (("overrides", str), ("scenes", (str, int)), ("seeds", int)):
            values = content[key]
            if not isinstance(values, list) or not all(
                isinstance(v, kinds) and not isinstance(v, bool) for v in values
            ):
                expected = "whole numbers" if key == "seeds" else "texts"
                raise ValueError(
                    f"{path}: {key} must be a list of {expected}, got {briefly(values)}"
                )
        scenes = tuple(map(str, content["scenes"]))
        try:
            return cls(
                path.parent.name, tuple(content["overrides"]), scenes, tuple(content["seeds"])
            )
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


@runtime_checkable
class Recipes(Protocol):
    """Knows which run a row of a benchmark is."""

    def identity(self, overrides: Sequence[str], seed: int) -> RunIdentity:
        """Recipe of a row."""
        ...


class Recorded:
    """Recipes of runs of an earlier results version, by the overrides that runs.csv keeps of them. A row without such a run has no recipe.

    Args:
        benchmark: Data, scenes and seeds.
        runs: Recipe, data recipe and overrides of each run.
    """

    def __init__(self, benchmark: Benchmark, runs: Iterable[tuple[str, str, str | None]]) -> None:
        first = benchmark.recorded
        self._rows: dict[frozenset[str], tuple[str, str]] = {}
        for recipe, data, overrides in set(runs):
            words = tuple(shlex.split(overrides or ""))
            if overrides and words[: len(first)] == first:
                self._rows[frozenset(words[len(first) :])] = recipe, data

    def identity(self, overrides: Sequence[str], seed: int) -> RunIdentity:
        """Recipe of a row, empty where none is known."""
        return RunIdentity(*self._rows.get(frozenset(overrides), ("", "")), seed)


class Composer:
    """Finds the identity of rows. Each distinct row is composed once and, if a file is given, remembered in it.

    Args:
        benchmark: Data, scenes and seeds.
        file: What each row is, for the content of `conf` that it names; committed with the tables, since composing all rows takes
            twenty seconds. It may be deleted at any time.
    """

    def __init__(self, benchmark: Benchmark, file: Path | None = None) -> None:
        self.benchmark = benchmark
        self._file = file
        self._conf = _tree_digest()
        self._head = {"conf": self._conf, "overrides": list(benchmark.recorded)}
        self._rows = _read_rows(file, self._head)
        self._composed = False

    def identity(self, overrides: Sequence[str], seed: int) -> RunIdentity:
        """Recipe of a row on this benchmark.

        Raises:
            UnknownOptionError: If an override is not one of the configuration's.
        """
        key = " ".join(overrides)
        if key not in self._rows:
            if self._file is not None and not self._composed:
                what = f"composing the rows of {self.benchmark.name}, once per change of conf"
                print(what, file=sys.stderr)
            self._composed = True
            try:
                found = _identified(self._conf, (*self.benchmark.overrides, *overrides))
                self._rows[key] = {"recipe": found.recipe, "data": found.data}
            except UnknownOptionError as error:
                self._rows[key] = {"refused": str(error)}
        known = self._rows[key]
        if "refused" in known:
            raise UnknownOptionError(known["refused"])
        return RunIdentity(**known, seed=seed)

    def require_sound(self, source: Path) -> None:
        """Do nothing if the configuration has the options of the benchmark itself.

        Args:
            source: File that it was read from.

        Raises:
            ValueError: If it has not: then no row can be run, and it is not the rows' fault.
        """
        try:
            self.identity((), self.benchmark.seeds[0])
        except UnknownOptionError as error:
            raise ValueError(
                f"{source}: overrides must be options of the configuration, got {error}; take the file from version control, or "
                "delete it, and python -m vlgs.ablate writes it again"
            ) from error

    def takes_scenes(self) -> bool:
        """Whether a run is told its scene (`data.scene`), or `data.root` or a scene file is the scene."""
        data = _compose(list(self.benchmark.overrides)).data
        if "scene" not in data or is_scene_file(OmegaConf.select(data, "scene", default=None)):
            return False
        if OmegaConf.is_missing(data, "scene") or data.scene is not None:
            return True
        return self.benchmark.scenes != (Path(data.root).resolve().name,)

    def save(self) -> None:
        """Keep what was composed for the next time."""
        if self._file is not None:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            content = self._head | {"rows": self._rows}
            text = json.dumps(content, indent=1, sort_keys=True) + "\n"
            write_changed(self._file, text.encode())


def is_scene_file(scene: str | None) -> bool:
    """Whether `data.scene` is the path of a file (conf/data/README.md), whose stem is then the scene's name."""
    return scene is not None and scene.endswith((".yaml", ".yml"))


def _read_rows(path: Path | None, head: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """What a file remembers of the same configuration and benchmark."""
    if path is None or not path.is_file():
        return {}
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        # Only a cache: it is made again.
        log.warning("%s: must be JSON, got: %s; the rows are composed anew", path, error)
        return {}
    if not isinstance(content, dict) or {key: content.get(key) for key in head} != head:
        return {}
    rows = content.get("rows")
    if isinstance(rows, dict) and all(map(_is_row, rows.values())):
        return rows
    log.warning("%s: rows must say what each row is; they are composed anew", path)
    return {}


def _is_row(content: Any) -> bool:
    if not isinstance(content, dict) or set(content) not in ({"recipe", "data"}, {"refused"}):
        return False
    return all(isinstance(value, str) for value in content.values())


def _tree_digest() -> str:
    """Content of the configuration folder, what of it counts, and version of what results mean."""
    left_out = (sorted(MOVES_NOTHING), sorted(SAID_ELSEWHERE), sorted(PLACES))
    counts = (RESULTS_VERSION, *left_out, sorted(AS_WITHOUT.items()))
    digest = hashlib.sha256(repr(counts).encode())
    for path in sorted(CONF.rglob("*.yaml")):
        digest.update(str(path.relative_to(CONF)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


@cache
def _identified(conf: str, overrides: tuple[str, ...]) -> RunIdentity:
    """What overrides mean with the content of `conf`, which takes a fifth of a second to find out."""
    return identity(_compose(list(overrides)))


def _compose(overrides: list[str]) -> DictConfig:
    from vlgs.command import composed

    try:
        return composed(overrides)
    except ValueError as error:
        raise UnknownOptionError(f"{' '.join(overrides) or 'the defaults'}: {error}") from error


def _moves(override: str) -> bool:
    """Whether an override can move a number."""
    key = override.partition("=")[0].lstrip("+~")
    return moves(key) and key not in {f"data.{name}" for name in PLACES}
