"""Checks that values of the configuration have the types of the constructors' arguments, and that numbers are finite. Imports no torch."""

import math
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

_LARGEST = 2**63 - 1
"""Larger integers fit into no tensor, file or counter."""


def require_types(who: str, hints: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Refuse values of another type than their hints, and numbers that are not finite; what has another hint is left alone.

    Args:
        who: Starts the message: ``trainer``.
        hints: Name -> type, as `typing.get_type_hints` has it: numbers, text, choices (Literal) and sequences of them are judged.
        values: Name -> what was given.

    Raises:
        ValueError: Names the value, what it must be and what it is.

    Example:
        >>> require_types("trainer", {"iterations": int}, {"iterations": True})
        Traceback (most recent call last):
        ValueError: trainer: iterations must be a whole number, got True
    """
    for name, value in values.items():
        hint = hints.get(name, Any)
        if not _fits(hint, value):
            quote = f"; quote it: \"'{value}'\"" if _wants_text(hint, value) else ""
            raise ValueError(
                f"{who}: {name} must be {_words(hint)}, got {value or repr(value)}{quote}"
            )


def require_fields(who: str, given: Any) -> None:
    """`require_types` of the fields of a dataclass, for its ``__post_init__``.

    Raises:
        ValueError: As there.
    """
    values = {field.name: getattr(given, field.name) for field in fields(given)}
    require_types(who, get_type_hints(type(given)), values)


def require_choice(who: str, name: str, value: object, choices: Iterable[str]) -> None:
    """Refuse a value that is none of the choices.

    Raises:
        ValueError: Names the value, the choices and what it is.
    """
    if value not in (known := tuple(choices)):
        raise ValueError(f"{who}: {name} must be one of {', '.join(known)}, got {value!r}")


def require_range(
    who: str, least: int | float, most: int | float, **values: int | float | None
) -> None:
    """Refuse numbers outside [least, most]; None, a value that was left open, passes.

    Raises:
        ValueError: Names the value, both bounds and what it is.
    """
    for name, value in values.items():
        if value is not None and not least <= value <= most:
            raise ValueError(f"{who}: {name} must be {least:g} to {most:g}, got {value}")


def _fits(hint: Any, value: Any) -> bool:
    if get_origin(hint) in (Union, types.UnionType):
        return any(_fits(part, value) for part in get_args(hint))
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if get_origin(hint) in (Sequence, list, tuple, Iterable):
        inner = (get_args(hint) or (Any,))[0]
        return _is_list(value) and all(_fits(inner, part) for part in value)
    if get_origin(hint) is Mapping:
        return isinstance(value, Mapping)
    if hint in (None, type(None)):
        return value is None
    if hint is bool or hint is str:
        return isinstance(value, hint)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST
    if hint is float:
        return (
            isinstance(value, int | float)
            and not isinstance(value, bool)
            and abs(value) <= _LARGEST
            and math.isfinite(value)
        )
    return isinstance(value, hint) if is_dataclass(hint) and isinstance(hint, type) else True


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def _wants_text(hint: Any, value: Any) -> bool:
    parts = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    return str in parts and isinstance(value, int | float)


def _words(hint: Any) -> str:
    """A type in words."""
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_words, get_args(hint))))
    if get_origin(hint) is Literal:
        return " or ".join(map(str, get_args(hint)))
    if get_origin(hint) in (Sequence, list, tuple, Iterable):
        return f"a list, each {_words((get_args(hint) or (Any,))[0])}"
    if is_dataclass(hint) and isinstance(hint, type):
        return f"the settings of a {hint.__name__}"
    names = {bool: "true or false", int: "a whole number", float: "a finite number", str: "text"}
    names |= {type(None): "null", Any: "anything"}
    return names.get(hint, "a mapping" if get_origin(hint) is Mapping else str(hint))
