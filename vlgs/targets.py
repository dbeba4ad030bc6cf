"""Decides which ``_target_`` may be constructed, by its name alone and before anything is imported. Imports no torch.

Allowed are the targets in `conf`, each at the key where it stands there (a fusion where a fusion is expected), and those of packages that
the command line trusts: ``plugins=[my_lab]``.
"""

import sys
from collections.abc import Callable, Collection, Mapping
from typing import Any

from vlgs.known import join, last, nodes, targets
from vlgs.sources import is_importable

_NOT_PLUGINS = frozenset(sys.stdlib_module_names) | {
    *("vlgs", "torch", "lightning", "pytorch_lightning", "hydra", "hydra_plugins", "omegaconf"),
    *("numpy", "scipy", "pandas", "PIL", "yaml", "antlr4", "transformers", "matplotlib", "pip"),
}
"""Packages that can never be plugins; most of them could run arbitrary code."""

_LOGGING = frozenset({"logging.StreamHandler", "logging.FileHandler", "logging.NullHandler"})
_STREAMS = frozenset({"ext://sys.stdout", "ext://sys.stderr"})
_OWN_FORMATTER = "vlgs.text.ScreenFormatter"
_OWN_CALLBACK = ("hydra.callbacks.table._target_", "vlgs.tables.multirun.MultirunTable")
_HYDRAS = ("hydra_plugins.", "hydra._internal.core_plugins.")
"""Where Hydra's launchers and sweepers are."""


TRUST = "plugins=[{}]"
"""How the command line of a run says that it trusts a package."""


def check_targets(config: Mapping[str, Any], plugins: object, trust: str = TRUST) -> None:
    """Refuse a configuration that would construct anything but our parts and those of trusted packages.

    Args:
        config: Plain and resolved, without Hydra's own part.
        plugins: Packages that the user trusts.
        trust: How the command at hand is told to trust one, for errors.

    Raises:
        ValueError: Names the key, the target and, where there is one, the way to allow it.
    """
    trusted = require_plugins(plugins)
    for key, node in nodes(config):
        for name, value in node.items():
            # Hydra's other words (_args_, _recursive_, ...) say how arguments are passed; no part of ours needs one.
            word = str(name).startswith("_") and name not in ("_target_", "_partial_")
            if word or (name == "_partial_" and last(key) != "text"):
                raise ValueError(f"config: {join(key, name)} must not be given, got {value!r}")
        if "_target_" in node:
            _check(key, node["_target_"], trusted, trust)


def check_hydra(node: Mapping[str, Any]) -> None:
    """Refuse what Hydra itself would construct or import before a command begins: callbacks, loggers, what a launcher is given.

    Args:
        node: The part ``hydra`` of a configuration, plain.

    Raises:
        ValueError: Names the key.
    """
    for key, inner in nodes(node, "hydra"):
        for name, value in inner.items():
            full = join(key, name)
            if key.startswith("hydra.callbacks."):
                if (full, value) != _OWN_CALLBACK:
                    raise ValueError(
                        f"config: hydra.callbacks must be left alone, got {full}={value!r}"
                    )
            elif name == "_target_":
                own = full in ("hydra.launcher._target_", "hydra.sweeper._target_")
                if not own or not str(value).startswith(_HYDRAS):
                    raise ValueError(f"config: {full} must be a launcher of Hydra's, got {value!r}")
            if key.startswith(("hydra.job_logging", "hydra.hydra_logging")):
                _check_logging(full, name, value)


def require_plugins(plugins: object) -> Collection[str]:
    """The packages, if they can be somebody's.

    Raises:
        ValueError: Names the first that cannot.
    """
    if not isinstance(plugins, list | tuple):
        raise ValueError(f"config: plugins must be a list of packages, got {plugins!r}")
    for package in plugins:
        named = isinstance(package, str) and package.isidentifier()
        if not named or package in _NOT_PLUGINS or package.startswith("_"):
            raise ValueError(
                "config: plugins must be packages of your own, not Python's library or what vlgs is built on, "
                f"got {package!r}"
            )
    return plugins


def require_importable(plugins: Collection[str]) -> None:
    """Do nothing if every package is there; none is imported.

    Raises:
        ValueError: Names the first that is not.
    """
    for package in plugins:
        if not is_importable(package):
            raise ValueError(
                f"plugins: {package} must be importable, from the current folder, PYTHONPATH or an installed package, got none of that name"
            )


def require_home(key: str, target: str, resolve: Callable[[str], Any]) -> None:
    """Refuse a target of a plugin that is not defined in its package, such as a function of a module that the package imports.

    Args:
        key: Of the target, for the message.
        target: Its name.
        resolve: Imports what the name means; not called for a name that cannot be a plugin's.

    Raises:
        ValueError: Names the key, the target and where it is from.
    """
    package = str(target).partition(".")[0]
    if package in _NOT_PLUGINS or not _is_name(target):
        raise ValueError(f"config: {key} must be a part of ours or a plugin's, got {target!r}")
    found = resolve(target)
    home = str(getattr(found, "__module__", None) or "elsewhere")
    if not callable(found) or home.partition(".")[0] != package:
        raise ValueError(
            f"config: {key} must come from its own package, got {target}, which is from {home}"
        )


def _check(key: str, target: object, trusted: Collection[str], trust: str) -> None:
    allowed = targets(last(key))
    if isinstance(target, str) and target in allowed:
        return
    package = str(target).partition(".")[0]
    if _is_name(target) and package in trusted:
        return
    choice = (
        f"one of {', '.join(sorted(allowed))}" if allowed else "left out, as nothing is made there"
    )
    advice = ""
    if _is_name(target) and package not in _NOT_PLUGINS:
        advice = f"; if you trust it, add its package on the command line: {trust.format(package)}"
    raise ValueError(f"config: {join(key, '_target_')} must be {choice}, got {target!r}{advice}")


def _check_logging(key: str, name: object, value: object) -> None:
    """`logging.config` calls what stands at ``()`` and imports what a class or ``ext://`` names."""
    allowed = name != "." and (name != "()" or value == _OWN_FORMATTER)
    if name == "class":
        allowed = value in _LOGGING
    if isinstance(value, str) and "ext://" in value:
        allowed = value in _STREAMS
    if not allowed:
        raise ValueError(
            f"config: {key} must be {', '.join(sorted(_LOGGING if name == 'class' else _STREAMS))}, got {value!r}"
        )


def _is_name(target: object) -> bool:
    """Whether a target is a plain dotted name: a module and what is in it, nothing hidden."""
    parts = target.split(".") if isinstance(target, str) else []
    return len(parts) > 1 and all(p.isidentifier() and not p.startswith("_") for p in parts)
