"""Which run a configuration is: the id that names its folder, and the recipe that makes it a row of a table. Imports no torch.

Hashed is what can move a number, as it would stand on a command line: ``fusion=self``, ``fusion.width=4``, ``seed=0``, the content of the
data and `RESULTS_VERSION`.

- Of a class its option counts: the one file of `conf/<group>`, or of the folder of ``--config-dir``, that names the class. Classes
  can be moved and renamed. ``raster=fast`` and ``raster.transmittance_min=0.01`` are one run, since both files construct one class.
- A class that stands in no such file, as in ``fusion._target_=my_lab.Gated``, counts by its path. One that is not ours counts by the
  sources of its package, too: who edits ``my_lab`` and runs the same command again trains another run.
- A part that is no group (``gaussians.densify``) counts by its values: only one class of ours can stand there.
- Every value counts that is not in `MOVES_NOTHING`. Defaults count like values that are given, so that a default can change
  without two different runs sharing an id. 1 and 1.0 are the same.
- A key that is new, or goes, changes no id where it has the value in `AS_WITHOUT`.
- What stands at a key whose children a user names (`vlgs.known.OPEN`) counts by being there, too.
- A defect that is mended changes the ids of the runs that it was in (`MENDED`), and no others.
- A key that was renamed counts by its former name (`vlgs.known.FORMER`).

Renaming an option does change ids: rows of results/ have to be carried over then.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from vlgs.known import OPEN, former, is_group, join, last, nodes, option, targets
from vlgs.sources import sources_digest

RESULTS_VERSION = 6
"""Part of every run id; raised by a change that can move a number."""

_MAPS = ("augment.extractor.segmenter", "augment.extractor.encoder")

MOVES_NOTHING = frozenset(
    {
        "head.cache_dir",
        "data.allow_missing_masks",  # refuses a scene, or does nothing
        "data.cache",
        "data.cache_bytes",
        "features",  # what it says stands in `augment` too
        "hydra",
        "logger",
        "on_existing",
        "pictures",
        "plugins",
        "progress",
        "raster.memory_budget",  # refuses a view, or does nothing
        "results",
        "threads",
        "trainer.checkpoint_every",
        "trainer.log_every",
        *(f"{part}.pretrained.{key}" for part in _MAPS for key in ("device", "weights")),
    }
)
"""Keys that cannot move a number, with all that is below them. Switches of `vlgs.skips` are not among them, though some of them move
no bit: what they move is the time that table `skips` compares."""

SAID_ELSEWHERE = frozenset(
    f"trainer.{key}"
    for key in (
        "codes_apart",
        "codes_faint",
        "indicator_reach",
        "language_weight",
        "language_error",
        "language_support",
        "best_rates_for",
        "best_shN",
    )
)
"""Keys that move a number through a key of another group alone, which counts: parts that do not read them have one id with any value."""

AFTER_TRAINING = ("protocol", "query", "text")
"""Groups that are asked for nothing before the last step: runs that differ in them alone have the same models."""

PLACES = frozenset({"root", "labels", "features", "vocabulary", "release", "scene"})
"""Keys of `data` that say where a scene lies, or which one it is, but not how it is read."""

GIVEN_FILES = (("gaussians", "init"), ("head", "weights"))
"""Keys that name a file to start from: what is in it counts for a run's id (through the fingerprint), not where it lies."""

GIVEN_FOLDERS = frozenset({"query.masks", "stages.second.folder"})
"""Keys, without the numbers of lists, that name a folder of files to learn from: likewise."""

AS_WITHOUT: Mapping[str, Any] = {
    "data.faults.shared": 0,
    "data.train_views": None,
    "gaussians.background": 0,
    "gaussians.background_opacity": None,
    "gaussians.codes": "none",
    "gaussians.codes_kept": 4,
    "gaussians.codes_shape_grad": True,
    "gaussians.clear_air": False,
    "gaussians.max_angle": 0,
    "gaussians.near_share": 0,
    "gaussians.densify.share_weights": False,
    "gaussians.densify.by_error": False,
    "gaussians.densify.long_axis": False,
    "gaussians.densify.prune_unseen": 0,
    "gaussians.densify.grad_threshold_size": 0,
    "head.training.draws": 1,
    "head.training.spread": 0,
    "head.training.faint": 0,
    "indicator.copies": 1,
    "indicator.reach": 0,
    "loss.language.weight": 1,
    "loss.language.support": 0,
    **dict.fromkeys(("loss.photometric", "loss.language", "loss.blended_view"), True),
    **dict.fromkeys(("lift.pixels", "stages.lift.pixels"), 250_000),
    **dict.fromkeys(("lift.border", "lift.alike", "lift.trial"), 0),
    **dict.fromkeys(("stages.lift.border", "stages.lift.alike", "stages.lift.trial"), 0),
    "query.masks": None,
    "raster.near_sigmas": 0,
    "stages": None,
    **dict.fromkeys(("trainer.average_language", "trainer.average_color"), 0),
    "trainer.color_decay": 1,
    "trainer.dropout": 0,
    "trainer.dropout_views": 30,
    "trainer.exposure": False,
    "trainer.half_size": 0,
    "trainer.transmittance_min": 0,
    "trainer.language_decay": 1,
    "trainer.learning_rates.exposure": 1e-3,
    "trainer.rates_for": None,
    "trainer.steps_scaler": 1,
}
"""Key -> the value with which everything is as if there were no such key. For keys that come after others have runs, or that go while
they have; the default may be another. What stands in a list counts without its number. An entry stays as it is for as long as the key is there, since changing it gives all runs other ids."""


def _prunes_large(counted: Mapping[str, Any]) -> bool:
    """What a background starts with was pruned as large after the first reset of the opacities."""
    densify = "gaussians.densify"
    resets, prunes = counted.get(f"{densify}.reset_every"), counted.get(f"{densify}.prune_large")
    return bool(resets and prunes)


def _has_own_shape_and_decay(counted: Mapping[str, Any]) -> bool:
    """Language's own shape had neither the decay of colour's nor its pace."""
    decays = "trainer.color_decay" in counted or "trainer.rates_for" in counted
    return decays and counted.get("sharing.covariances") is False


MENDED: Mapping[str, Callable[[Mapping[str, Any]], bool]] = {
    "mended.large_background": _prunes_large,
    "mended.decay_of_copies": _has_own_shape_and_decay,
}
"""Name -> whether a configuration, by what counts of it, moved its numbers when a defect was mended. For what few runs have; what many have
raises `RESULTS_VERSION`."""


@dataclass(frozen=True)
class RunIdentity:
    """A run as a table knows it, before any data is read: runs that differ in scene and seed only share a recipe."""

    recipe: str
    """Hash of the configuration without data and seed."""
    data: str
    """Hash of how the data is read, wherever it lies and whichever scene it is."""
    seed: int


def run_id(config: DictConfig, fingerprint: str) -> str:
    """Hash of all that can move a number; `fingerprint` stands for the content of the data, wherever it lies."""
    plain = _plain(config)
    del plain["data"]
    return _digest(_without_files(plain) | {"data": fingerprint})


def trained_id(config: DictConfig, fingerprint: str) -> str:
    """`run_id` without `AFTER_TRAINING`: equal where the models of two runs are, bit for bit."""
    plain = _plain(config)
    for key in ("data", *AFTER_TRAINING):
        del plain[key]
    return _digest(_without_files(plain) | {"data": fingerprint})


def identity(config: DictConfig) -> RunIdentity:
    """What tells runs of a table apart; see `RunIdentity`."""
    plain = _plain(config)
    data, seed = plain.pop("data"), plain.pop("seed")
    given = {former(".".join(key)): (plain.get(key[0]) or {}).get(key[1]) for key in GIVEN_FILES}
    given |= given_folders(config)
    names = {key: Path(str(path)).name for key, path in given.items() if path is not None}
    read = {key: value for key, value in data.items() if key not in PLACES}
    return RunIdentity(
        _digest(_without_files(plain) | names), _digest(_counted(read, "data")), seed
    )


def given_folders(config: DictConfig) -> dict[str, str]:
    """Dotted key -> folder, of all `GIVEN_FOLDERS` that a configuration names."""
    every = nodes(_plain(config))
    found = {join(key, name): value for key, node in every for name, value in node.items()}
    return {key: str(path) for key, path in found.items() if path and _bare(key) in GIVEN_FOLDERS}


def moves(key: str) -> bool:
    """Whether a dotted key can move a number.

    Example:
        >>> moves("trainer.iterations"), moves("trainer.log_every"), moves("logger.loggers")
        (True, False, False)
    """
    names = key.split(".")
    return not any(".".join(names[: n + 1]) in MOVES_NOTHING for n in range(len(names)))


def _plain(config: DictConfig) -> dict[str, Any]:
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def _without_files(plain: Mapping[str, Any]) -> dict[str, Any]:
    files = {former(".".join(key)) for key in GIVEN_FILES}
    return {key: value for key, value in _counted(plain).items() if key not in files}


def _counted(node: Any, key: str = "") -> dict[str, Any]:
    """Dotted keys and values of what can move a number; a class stands as its option at its own key."""
    leaves = dict(_leaves(node, key))
    counted = {former(k): v for k, v in leaves.items() if k not in AS_WITHOUT or AS_WITHOUT[k] != v}
    if not key:
        counted["loss"] = "default"  # as the group counted while one class held all terms
    mended = {} if key else {name: True for name, had in MENDED.items() if had(counted)}
    return counted | mended


def _leaves(node: Any, key: str) -> Iterator[tuple[str, Any]]:
    if key in MOVES_NOTHING or key in SAID_ELSEWHERE:
        return
    if key in GIVEN_FOLDERS:
        node = None if node is None else True  # what is in it counts
    if not isinstance(node, Mapping):
        yield key, _value(node, key)
        return
    if "_target_" in node:
        yield from _class(key, str(node["_target_"]))
    for name, child in node.items():
        if not str(name).startswith("_"):
            yield from _leaves(child, join(key, name))


def _class(key: str, target: str) -> Iterator[tuple[str, str | bool]]:
    """What a class counts by; nothing where no other class of ours can stand."""
    name = option(key, target, _own_folders())
    if target not in targets(last(key)):
        yield from _source(key, target)
    if key.rpartition(".")[0] in OPEN:
        yield key, True
        if target not in targets(last(key)):
            yield join(key, "_target_"), target
    elif name is not None:
        yield key, name
    elif is_group(key) or target not in targets(last(key)):
        yield join(key, "_target_"), target


def _source(key: str, target: str) -> Iterator[tuple[str, str]]:
    """What a class of somebody else's package counts by beside its name: the sources of the package, where it has any."""
    digest = sources_digest(target.partition(".")[0])
    if digest is not None:
        yield join(key, "_source_"), digest


def _value(node: Any, key: str) -> Any:
    """A value that is no mapping, with one spelling of each number."""
    if isinstance(node, list):
        return [_counted(i, key) if isinstance(i, Mapping) else _value(i, key) for i in node]
    return int(node) if isinstance(node, float) and node.is_integer() else node


def _own_folders() -> list[Path]:
    """Folders of the user's own options on the command line of this process."""
    from hydra.core.hydra_config import HydraConfig

    if not HydraConfig.initialized():
        return []
    sources = HydraConfig.get().runtime.config_sources
    return [Path(source.path) for source in sources if source.provider == "command-line"]


def _bare(key: str) -> str:
    return ".".join(name for name in key.split(".") if not name.isdigit())


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(
        {**content, "results_version": RESULTS_VERSION}, sort_keys=True, separators=(",", ":")
    )
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
