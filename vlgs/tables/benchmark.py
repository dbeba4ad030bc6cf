"""On what the tables of a folder are run, and which run a row means there. Imports no torch."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from vlgs.config import CONF, RESULTS_VERSION, Identity, check_targets, identity
from vlgs.files import write_atomically


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


class Composer:
    """Row to identity; every distinct row is composed once, and remembered in a file if there is one.

    Args:
        benchmark: Data, scenes and seeds.
        cache: File of recipes that were composed before, by content of `conf` and overrides; it may be deleted at any time.
    """

    def __init__(self, benchmark: Benchmark, cache: Path | None = None) -> None:
        self.benchmark = benchmark
        self._cache = cache
        self._known = _read_cache(cache)
        self._tree = _tree_digest()

    def identity(self, overrides: Sequence[str], seed: int) -> Identity:
        """Recipe of a row on this benchmark.

        Raises:
            ValueError: If an override is not one of the configuration's.
        """
        words = [*self.benchmark.overrides, *overrides]
        key = hashlib.sha256("\0".join([self._tree, *words]).encode()).hexdigest()
        if key not in self._known:
            found = identity(_compose(words))
            self._known[key] = {"recipe": found.recipe, "data": found.data}
        return Identity(**self._known[key], seed=seed)

    def takes_scenes(self) -> bool:
        """Whether the data set holds several scenes (`data.scene`)."""
        return "scene" in _compose(list(self.benchmark.overrides)).data

    def save(self) -> None:
        """Keep what was composed for the next time."""
        if self._cache is not None:
            self._cache.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._cache, json.dumps(self._known).encode())


def _read_cache(path: Path | None) -> dict[str, dict[str, str]]:
    if path is None or not path.is_file():
        return {}
    try:
        return json.loads(path.read_text())
    except json.JSONDecodeError:
        return {}  # only a cache


def _tree_digest() -> str:
    """Content of the configuration folder and version of what results mean."""
    digest = hashlib.sha256(str(RESULTS_VERSION).encode())
    for path in sorted(CONF.rglob("*.yaml")):
        digest.update(str(path.relative_to(CONF)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _compose(overrides: list[str]) -> DictConfig:
    from hydra import compose, initialize_config_dir
    from hydra.errors import ConfigCompositionException, HydraException

    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = compose("config", overrides=overrides)
        check_targets(config)
    except (ConfigCompositionException, OmegaConfBaseException, HydraException) as error:
        reason = str(error).strip().partition("\n")[0]
        raise ValueError(f"{' '.join(overrides) or 'the defaults'}: {reason}") from error
    return config


def _is_a_place(override: str) -> bool:
    key = override.partition("=")[0].lstrip("+")
    return key in {"data.root", "data.labels", "data.features", "data.vocabulary", "results"}
