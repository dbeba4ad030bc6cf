"""The configuration: where it lives and what it may construct. Imports no torch."""

import inspect
import os
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vlgs import targets
from vlgs.known import CONF as CONF
from vlgs.known import FORMER, is_ours, join, last, nodes, renamed, unread
from vlgs.manual import list_options
from vlgs.text import visible
from vlgs.values import require_range, require_types

LEVELS = (1, 2, 3)
"""Mask levels of ``levels=separate`` and ``joint``: subpart, part, whole, finest first (conf/README.md, D.8)."""

CODES: Mapping[str, int] = {"single": 1, "separate": 1, "joint": len(LEVELS)}
"""Value of ``levels`` -> language codes of a Gaussian."""

OmegaConf.register_new_resolver(
    "code_channels", lambda levels, width: width * CODES.get(levels, 1), replace=True
)
"""``${code_channels:${levels},${head.dim}}``: language channels of a Gaussian, which is what a fusion is built for."""

OmegaConf.register_new_resolver("list_options", list_options, replace=True)
"""``${list_options:method}`` in the text of ``--help``."""

MOST_THREADS = 256
"""Largest number of threads; no machine has more, and starting them would fail half-way."""


def check_config(config: DictConfig) -> None:
    """Refuse a configuration of `vlgs.run` with keys, classes or values that cannot be, before anything is constructed.

    What options ask of each other is checked by `vlgs.experiment.construct`.

    Raises:
        ValueError: Names the key, what it must be and what it is.
    """
    require_given(config)
    check_targets(config)
    _check_root(config)
    if config.levels != "single" and "level" not in config.data:
        raise ValueError(
            f"config: data must have mask levels with levels={config.levels}, got no data.level"
        )


def require_given(config: DictConfig) -> None:
    """Do nothing if every value is given that has no default.

    Raises:
        ValueError: Names the first key without one.
    """
    plain = OmegaConf.to_container(
        config
    )  # not resolved: what is not given may be all that another value lacks
    places = [
        join(key, name) for key, node in nodes(plain) for name, v in node.items() if v == "???"
    ]
    if places:
        first = min(places)
        raise ValueError(f"config: {first} must be given, as {first}=VALUE; got nothing")


def check_targets(
    config: DictConfig,
    name: str = "config",
    plugins: Sequence[str] | None = None,
    trust: str = targets.TRUST,
) -> None:
    """Refuse a configuration with keys that nothing reads, or that would construct something that is neither ours nor trusted.

    Args:
        config: Composed.
        name: Of the file in `conf` that it was composed from.
        plugins: Packages that are trusted; by default those that the configuration names, which must then come from a command line.
        trust: How the command at hand is told to trust one, for errors.

    Raises:
        ValueError: Names the key, and what could have been meant or how to allow it.
    """
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    except OmegaConfBaseException as error:
        require_given(config)
        raise _unresolved(error) from error
    assert isinstance(plain, dict)
    plain = {str(key): value for key, value in plain.items() if key != "hydra"}
    for key, meant in unread(plain, name):
        hint = f"; did you mean {' or '.join(meant)}?" if meant else ""
        if meant and last(meant[0]) == "_target_":
            hint = f"; {meant[0]} must say whose it is"
        raise ValueError(
            f"config: {key} must be a key that is read, got one that nothing reads{hint}"
        )
    named = plain.get("plugins", []) if plugins is None else plugins
    targets.check_targets(plain, named, trust)


def _require_place(results: str) -> None:
    """Do nothing if the folder is there or can be made, so that nobody waits for a run that cannot be kept."""
    wanted = (
        f"config: results must be a folder that is there or can be made, got {visible(results)}"
    )
    path = Path(results).absolute()
    for place in (path, *path.parents):
        try:
            os.lstat(place)
        except (FileNotFoundError, NotADirectoryError):
            continue
        except (OSError, ValueError) as error:
            raise ValueError(f"{wanted}: {getattr(error, 'strerror', error)}") from error
        if not place.is_dir():
            raise ValueError(f"{wanted}: {visible(str(place))} is no folder")
        if not os.access(place, os.W_OK | os.X_OK):
            raise ValueError(f"{wanted}: {visible(str(place))} may not be written to")
        return


def _unresolved(error: OmegaConfBaseException) -> ValueError:
    reason = str(error).strip().partition("\n")[0]
    nothing = re.fullmatch(r".* returned `None` of type .*: \$\{\.(\w+)\}", reason)
    if nothing:
        beside = join((error.full_key or "").rpartition(".")[0], nothing[1])
        return ValueError(
            f"config: {beside} must be given, as {beside}=VALUE; got nothing, and {error.full_key} needs it"
        )
    former = next((old for old in FORMER.values() if f"'{old}" in reason), None)
    hint = f"; {former} is called {renamed(former)} now" if former is not None else ""
    return ValueError(f"config: {error.full_key} must have a value, got: {reason}{hint}")


def _check_root(config: DictConfig) -> None:
    """Check the keys of the root, which no constructor checks."""
    hints = {
        "seed": int,
        "threads": int,
        "progress": bool,
        "pictures": bool,
        "results": str,
        "on_existing": Literal["resume", "refuse"],
        "levels": Literal["single", "separate", "joint"],
    }
    require_types("config", hints, {key: config.get(key) for key in hints})
    require_range("config", 0, 2**63 - 1, seed=config.seed)
    require_range("config", 1, MOST_THREADS, threads=config.threads)
    if not config.results:
        raise ValueError("config: results must be a folder, got ''")
    _require_place(config.results)
    for key in ("logger.loggers", "stages"):
        parts, name = OmegaConf.select(config, key), last(key)
        if not ((key == "stages" and parts is None) or _are_parts(parts)):
            raise ValueError(f"config: {key} must be a list of {name}, got {parts}")


def _are_parts(node: Any) -> bool:
    """Whether a node is a list of things to construct."""
    return isinstance(node, ListConfig) and all(
        isinstance(one, DictConfig) and "_target_" in one for one in node
    )


def instantiate(config: Any, **arguments: Any) -> Any:
    """Construct what a `_target_` names; its arguments have the types that it asks for, and a plugin's part is really a plugin's.

    Raises:
        ValueError: If a name is neither ours nor that of something in a plugin (as in ``vlgs.data.<module>.os.system``), an argument is missing or has
            another type, or the constructor says so itself, without Hydra's wrapping.
        OSError: Likewise.
    """
    from hydra.errors import InstantiationException
    from hydra.utils import instantiate

    plain = OmegaConf.to_container(config, resolve=True)
    for key, node in nodes(plain):
        if "_target_" in node:
            name, target = join(key, "_target_"), str(node["_target_"])
            if not is_ours(target):
                targets.require_home(name, target, find)
            made = find(target)
            given = dict(node) | (arguments if not key else {})
            _require_arguments(_who(config, key, target), made, given)
    try:
        # Lists and mappings come as Python's: in OmegaConf's own list a dataclass that was made would be settings again.
        return instantiate(config, _convert_="partial", **arguments)
    except InstantiationException as error:
        if isinstance(error.__cause__, (ValueError, OSError)):
            raise error.__cause__ from None
        if isinstance(error.__cause__, ModuleNotFoundError):
            package = error.__cause__.name
            raise ValueError(
                f"config: {config._target_} must be installed, got no {package}"
            ) from error
        raise


def find(target: str) -> Any:
    """What a dotted name means, imported. The one of Hydra's interface would write three lines of its own before it raises.

    Raises:
        ValueError: If there is no such thing, or it cannot be imported; says why in a line.
    """
    from hydra._internal.utils import _locate

    try:
        return _locate(target)
    except (ImportError, ValueError) as error:
        cause = error.__cause__ or error
        reason = visible(" ".join(f"{type(cause).__name__}: {cause}".split()))
        raise ValueError(
            f"config: {target} must be there and importable, got {reason:.300}"
        ) from error


def _require_arguments(who: str, made: Callable[..., Any], given: Mapping[str, Any]) -> None:
    """Compare arguments with a constructor's signature; nested parts are checked separately."""
    values = {k: v for k, v in given.items() if k not in ("_target_", "_partial_")}
    signature = inspect.signature(made)
    try:
        (signature.bind_partial if given.get("_partial_") else signature.bind)(**values)
    except TypeError as error:
        raise ValueError(
            f"{who}: arguments must be those of {made.__name__}, got others ({error})"
        ) from error
    plain = {k: _unmade(v) for k, v in values.items() if not _is_part(v)}
    hints = typing.get_type_hints(made.__init__ if isinstance(made, type) else made)
    # Constructors know their choices, and say them in words of theirs.
    judged = {k: h for k, h in hints.items() if typing.get_origin(h) is not Literal}
    require_types(who, judged, plain)


def _is_part(value: Any) -> bool:
    return isinstance(value, Mapping) and "_target_" in value


def _unmade(value: Any) -> Any:
    """A value without the parts that a list of it has, which are judged when they are made."""
    return [v for v in value if not _is_part(v)] if isinstance(value, list) else value


def _who(config: Any, key: str, target: str) -> str:
    """The name in errors of a part: its group, taken from its key or else from its module."""
    return last(key) or last(str(config._get_full_key(None) or "")) or target.rpartition(".")[2]


def split_override(override: str) -> tuple[str, str]:
    """Key and value of a command-line argument; the value is empty where there is no ``=``."""
    key, _, value = override.partition("=")
    return key, value


_NOT_TEXT = ("true", "false", "null", "nan", "inf")
"""Words that Hydra reads as something else, in any case of letters."""


def quote_override(key: str, value: str) -> str:
    r"""An argument for Hydra that sets `key` to just this text, whatever is in it: blanks, umlauts, brackets, commas, quotes, ``${``.

    A plain word is left bare, so that commands stay as people type them.

    Example:
        >>> quote_override("data.root", "scenes/kitchen"), quote_override("data.root", "my scenes/[1], Ö")
        ('data.root=scenes/kitchen', "data.root='my scenes/[1], Ö'")
    """
    if re.fullmatch(r"[A-Za-z_./][\w./-]*", value, re.ASCII) and value.lower() not in _NOT_TEXT:
        return f"{key}={value}"
    # Within quotes Hydra takes a backslash as one, except before a quote; OmegaConf, which reads the text then, before ${.
    text = re.sub(r"(\\*)\$\{", lambda match: match[1] * 2 + r"\${", value)
    text = re.sub(r"(\\*)('|\Z)", lambda match: match[1] * 2 + (r"\'" if match[2] else ""), text)
    return f"{key}='{text}'"


def literal_override(argument: str) -> str:
    """A command-line argument as given where Hydra reads one value in it, else with its value taken as text.

    For commands that know no sweeps: ``data.root=/x/a, b`` is a folder, not two values.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    key, value = split_override(argument)
    try:
        read = OverridesParser.create().parse_override(argument)
    except HydraException:
        return quote_override(key, value)
    blank = isinstance(read.value(), str) and value != value.strip()
    return quote_override(key, value) if read.is_sweep_override() or blank else argument


def override_value(argument: str) -> Any:
    """The value that Hydra reads in an argument, without its quotes.

    Example:
        >>> override_value("data.root='my scenes'")
        'my scenes'
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return OverridesParser.create().parse_override(argument).value()
