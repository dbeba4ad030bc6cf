"""The configuration: where it lives, what it may construct, and which run it names. Imports no torch."""

import hashlib
import importlib.resources
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

_CHECKOUT = Path(__file__).resolve().parents[1]
_PACKAGE = Path(str(importlib.resources.files("vlgs")))
CONF = _CHECKOUT / "conf" if (_CHECKOUT / "conf" / "config.yaml").is_file() else _PACKAGE / "conf"
"""Folder of the configuration: beside the package in a checkout, inside it in an installed wheel."""

TRUSTED_PACKAGES = ("vlgs", "torch", "lightning")
"""Packages that a `_target_` may name; `plugins` in the configuration adds more."""

NOT_PART_OF_A_RUN = frozenset(
    {
        "data",
        "results",
        "logger",
        "progress",
        "pictures",
        "on_existing",
        "threads",
        "plugins",
        "hydra",
    }
)
"""Keys that cannot move a number. `data` is replaced by the fingerprint of the scene it leads to, so that a run does
not depend on the folder that its data lies in."""

LEVELS = (1, 2, 3)
"""Mask levels of ``levels=separate`` and ``joint``: subpart, part, whole, finest first (systems.md D.8)."""

OmegaConf.register_new_resolver(
    "code_channels",
    lambda levels, width: width * (len(LEVELS) if levels == "joint" else 1),
    replace=True,
)
"""``${code_channels:${levels},${codec.dim}}``: language channels of a Gaussian, which is what a fusion is built for."""

_NO_FUSION = "vlgs.fusion.none.NoFusion"
_PER_LEVEL = "vlgs.indicator.PerLevel"
_NOT_LEARNED = ("vlgs.indicator.ColourOpacity", "vlgs.indicator.Fixed")

GIVEN_FILES = (("gaussians", "init"), ("codec", "weights"))
"""Keys that name a file to start from: what is in it counts for a run's id (through the fingerprint), not where it lies."""


def check_config(config: DictConfig) -> None:
    """Refuse a configuration of `vlgs.run` that cannot work, before anything is read.

    Raises:
        ValueError: Names the key, what it must be and what it is.
    """
    missing = sorted(OmegaConf.missing_keys(config))
    if missing:
        raise ValueError(f"config: {missing[0]} must be given, as {missing[0]}=VALUE; got nothing")
    for key, least in (("seed", 0), ("threads", 1)):
        value = config[key]
        if not isinstance(value, int) or value < least:
            raise ValueError(f"config: {key} must be an integer of at least {least}, got {value}")
    if config.on_existing not in ("resume", "refuse"):
        raise ValueError(f"config: on_existing must be resume or refuse, got {config.on_existing}")
    if config.levels not in ("single", "separate", "joint"):
        raise ValueError(f"config: levels must be single, separate or joint, got {config.levels}")
    if config.levels != "single" and "level" not in config.data:
        raise ValueError(
            f"config: data must have mask levels with levels={config.levels}, got no data.level"
        )
    if config.indicator._target_ == _PER_LEVEL and config.levels != "joint":
        raise ValueError(
            f"config: levels must be joint with indicator=per_level, got {config.levels}"
        )
    if config.sharing.get("lifted", False):
        for group, targets in (("fusion", (_NO_FUSION,)), ("indicator", _NOT_LEARNED)):
            if config[group]._target_ not in targets:
                raise ValueError(
                    f"config: {group} must be {' or '.join(targets)} with sharing=lifted, as nothing trains it, "
                    f"got {config[group]._target_}"
                )
    if not config.sharing.get("means", True) and config.fusion._target_ != _NO_FUSION:
        raise ValueError(
            "config: fusion must be none with sharing=none, as a Gaussian then carries colour or language but not both, "
            f"got {config.fusion._target_}"
        )
    check_targets(config)


def check_targets(config: DictConfig) -> None:
    """Refuse a configuration that would construct something outside the trusted packages.

    Raises:
        ValueError: Names the key, the target and how to allow it.
    """
    trusted = (*TRUSTED_PACKAGES, *config.get("plugins", []))
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    for key, target in _targets(plain, ""):
        package = str(target).partition(".")[0]
        if package not in trusted or not all(
            part.isidentifier() for part in str(target).split(".")
        ):
            raise ValueError(
                f"config: {key} must name something in {', '.join(trusted)}, got {target}; "
                f"if you trust it, add its package: plugins=[{package}]"
            )


def instantiate(config: Any, **arguments: Any) -> Any:
    """Construct what a `_target_` names, and check that it really comes from where its name says.

    Raises:
        ValueError: If the resolved object lives outside the package that was named (`vlgs.data.os.system`), or its own
            error about a bad value, without Hydra's wrapping.
        OSError: Likewise.
    """
    from hydra.errors import InstantiationException
    from hydra.utils import get_object, instantiate

    for key, target in _targets(OmegaConf.to_container(config, resolve=True), ""):
        home = getattr(get_object(str(target)), "__module__", "") or ""
        if home.partition(".")[0] != str(target).partition(".")[0]:
            raise ValueError(
                f"config: {key} must come from its own package, got {target}, which is from {home}"
            )
    try:
        return instantiate(config, **arguments)
    except InstantiationException as error:
        if isinstance(error.__cause__, (ValueError, OSError)):
            raise error.__cause__ from None
        raise


RESULTS_VERSION = 3
"""Part of every run id; raised by a change that can move a number."""

PLACES = frozenset(
    {"root", "labels", "features", "vocabulary", "release", "cache_bytes", "cache", "scene"}
)
"""Keys of `data` that say where a scene lies, or which one it is, but not how it is read."""


def run_id(config: DictConfig, fingerprint: str) -> str:
    """Hash of all that can move a number: the resolved configuration, the data's content and the results version."""
    return _digest({"config": _moving(config), "data": fingerprint})


def split_override(override: str) -> tuple[str, str]:
    """Key and value of a command-line argument; the value is empty where there is no ``=``."""
    key, _, value = override.partition("=")
    return key, value


@dataclass(frozen=True)
class Identity:
    """A run as a table knows it, before any data is read: runs that differ in scene and seed only share a recipe."""

    recipe: str
    """Hash of the configuration without data and seed."""
    data: str
    """Hash of how the data is read, wherever it lies and whichever scene it is."""
    seed: int


def identity(config: DictConfig) -> Identity:
    """What tells runs of a table apart; see `Identity`."""
    moving = _moving(config)
    seed = moving.pop("seed")
    given = {key: config.get(group, {}).get(key) for group, key in GIVEN_FILES}
    moving["given"] = {key: Path(path).name for key, path in given.items() if path is not None}
    data = OmegaConf.to_container(config.data, resolve=True, throw_on_missing=False)
    assert isinstance(data, dict)
    kept = {str(k): v for k, v in data.items() if k not in PLACES}
    return Identity(_digest(moving), _digest(kept), seed)


def _moving(config: DictConfig) -> dict[str, Any]:
    """The part of a configuration that can move a number, without the data."""
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    assert isinstance(plain, dict)
    kept = {str(k): v for k, v in plain.items() if k not in NOT_PART_OF_A_RUN}
    if isinstance(kept.get("codec"), dict):
        kept["codec"] = {k: v for k, v in kept["codec"].items() if k != "cache_dir"}
    kept.pop("features", None)  # what it says stands in `augment` too
    if "augment" in kept:
        kept["augment"] = _without(kept["augment"], frozenset({"weights", "device"}))
    for group, key in GIVEN_FILES:
        if isinstance(kept.get(group), dict):
            kept[group] = {k: v for k, v in kept[group].items() if k != key}
    return kept


def _without(node: Any, keys: frozenset[str]) -> Any:
    if isinstance(node, dict):
        return {key: _without(value, keys) for key, value in node.items() if key not in keys}
    return node


def _digest(content: dict[str, Any]) -> str:
    content = content | {"results_version": RESULTS_VERSION}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _targets(node: Any, key: str) -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict):
        for name, child in node.items():
            if name == "_target_":
                yield f"{key}._target_".lstrip("."), child
            else:
                yield from _targets(child, f"{key}.{name}")
    elif isinstance(node, list):
        for index, child in enumerate(node):
            yield from _targets(child, f"{key}.{index}")
