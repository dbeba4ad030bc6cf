"""Names of files and folders on a command line: typed as they are, quoted for Hydra's grammar. Imports no torch."""

import os
import re
import shlex
import sys
from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import QuotedString
from hydra.errors import HydraException

from vlgs.config import quote_override, split_override

_PLACE = re.compile(
    r"results|gaussians\.init|head\.(weights|cache_dir)|text\.model|hydra\.(run|sweep)\.dir"
    r"|data\.(root|scene|images|labels|features|vocabulary|cache|release\.labels)"
    r"|(features|augment)\.(.+\.)?(out|weights|folder)"
)
"""Keys whose value names a file or folder."""

_INTERPOLATION = re.compile(r"(?<!\\)\\(\$\{[^{}'\\]+\})")
"""A whole ``${...}`` whose dollar `quote_override` has escaped."""


def quote_places(arguments: Sequence[str]) -> list[str]:
    """A command line for Hydra in which the name of a file or folder is just that, whatever characters it has.

    A leading ``~/`` is the home folder, which a shell does not expand there. What is quoted already, ``null`` and ``${...}`` keep
    their meaning, and with ``-m`` so do commas: they separate the values of a sweep.

    Raises:
        ValueError: If a name is not UTF-8, or has the beginning of an interpolation and not its end: no configuration carries it.

    Example:
        >>> quote_places(["data=colmap", "data.root=/x/Ü (1), [b]=c"])
        ['data=colmap', "data.root='/x/Ü (1), [b]=c'"]
    """
    several = bool({"-m", "--multirun"} & set(arguments))
    return [_quoted(argument, several) for argument in arguments]


def take_command_line() -> None:
    """Quote the places on the command line of this process, before Hydra reads it; exit status 1 where that cannot be."""
    try:
        sys.argv[1:] = quote_places(sys.argv[1:])
    except ValueError as error:
        sys.exit(f"error: {error}")


def command_line(module: str, overrides: Sequence[str]) -> str:
    """What a person types to give these overrides again, to be pasted into a shell.

    Example:
        >>> command_line("vlgs.run", ["seed=1", "data.root='/x/Ü (1)'"])
        "python -m vlgs.run seed=1 'data.root=/x/Ü (1)'"
    """
    return shlex.join(["python", "-m", module, *map(_as_typed, overrides)])


def _is_place(key: str) -> bool:
    return _PLACE.fullmatch(key.lstrip("+")) is not None


def _quoted(argument: str, several: bool) -> str:
    key, value = split_override(argument)
    if not _is_place(key) or value in ("", "null"):
        return argument
    read = _read(argument)
    is_quoted = isinstance(read, QuotedString)
    if is_quoted or (several and _is_sweep(argument)):
        return argument
    if several and "," in value:
        parts = [_quoted(f"{key}={part.strip()}", several=False) for part in value.split(",")]
        return f"{key}={','.join(split_override(part)[1] for part in parts)}"
    place = os.path.expanduser(value) if value.startswith("~/") else value
    if read == place:
        return argument
    quoted = _INTERPOLATION.sub(r"\1", quote_override(key, place))
    if r"\${" in quoted or _has_surrogates(place):
        raise ValueError(
            f"command: names of files must be UTF-8 without a bare ${{, got {argument!r}"
        )
    return quoted


def _has_surrogates(text: str) -> bool:
    return any("\ud800" <= letter <= "\udfff" for letter in text)


def _read(argument: str) -> object:
    """What Hydra makes of the value: text, `QuotedString` or something else; None where it makes nothing of it."""
    try:
        override = OverridesParser.create().parse_override(argument)
    except HydraException:
        return None
    return None if override.is_sweep_override() else override._value


def _is_sweep(argument: str) -> bool:
    try:
        return OverridesParser.create().parse_override(argument).is_sweep_override()
    except HydraException:
        return False


def _as_typed(override: str) -> str:
    """The override without the quotes that `quote_places` gives it."""
    key, _ = split_override(override)
    read = _read(override)
    if not isinstance(read, QuotedString) or not _is_place(key):
        return override
    typed = f"{key}={read.text}"
    return typed if quote_places([typed]) == [override] else override
