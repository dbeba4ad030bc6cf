"""YAML from others: a tree of values, each of which knows where it stands."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.untrusted.text import read_text

LONGEST, DEEPEST = 1 << 20, 20
"""Characters of a file, and lists and mappings in each other."""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class Node:
    """A value and its place. Whoever asks for what it is not gets a `SceneError` that names file, place and value."""

    file: Path
    place: str
    """``props.cup.parts[0]``; empty for the whole file."""
    value: Any

    def wrong(self, expected: str, got: object = None) -> SceneError:
        """The error that it must be something else."""
        told = repr(self.value if got is None else got)
        told = told if len(told) <= 80 else f"{told[:80]}..."
        return SceneError(Fault(str(self.file), f"must be {expected}, got {told}", "", self.place))

    def entries(self, keys: Collection[str], needed: Collection[str] = ()) -> dict[str, "Node"]:
        """The values of a mapping that has no other keys than these, and the needed ones of them."""
        entries = self.mapping()
        for key in entries:
            if key not in keys:
                raise self.wrong(f"a mapping with the keys {', '.join(keys)}", key)
        for key in needed:
            if key not in entries:
                raise self.wrong(f"a mapping with the key {key}", list(entries))
        return entries

    def mapping(self) -> dict[str, "Node"]:
        """The values of a mapping whose keys are text."""
        if not isinstance(self.value, dict):
            raise self.wrong("a mapping")
        for key in self.value:
            if not isinstance(key, str):
                raise self.wrong("a mapping whose keys are text", key)
        dot = "." if self.place else ""
        return {k: Node(self.file, f"{self.place}{dot}{k}", v) for k, v in self.value.items()}

    def items(self, least: int, most: int) -> list["Node"]:
        """The values of a list."""
        if not isinstance(self.value, list) or not least <= len(self.value) <= most:
            count = str(least) if least == most else f"{least} to {most}"
            raise self.wrong(f"a list of {count}")
        return [Node(self.file, f"{self.place}[{i}]", v) for i, v in enumerate(self.value)]

    def number(self, least: int | float, most: int | float) -> float:
        """A number in [least, most]."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.wrong(f"a number from {least:g} to {most:g}")
        if not least <= value <= most or math.isnan(value):
            raise self.wrong(f"a number from {least:g} to {most:g}")
        return float(value)

    def numbers(self, count: int, least: int | float, most: int | float) -> tuple[float, ...]:
        """So many numbers in [least, most]."""
        return tuple(node.number(least, most) for node in self.items(count, count))

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            raise self.wrong("true or false")
        return self.value

    def option(self, options: Collection[str]) -> str:
        """One of some words."""
        if not isinstance(self.value, str) or self.value not in options:
            raise self.wrong(f"one of {', '.join(options)}")
        return self.value


def read_yaml(path: Path) -> Node:
    """The content of a small YAML file without aliases, keys that come twice, and tags.

    Raises:
        FileNotFoundError: If there is no such file.
        SceneError: If it is something else; names the line.
    """
    text = read_text(path)
    if len(text) > LONGEST:
        raise _refused(path, f"must have at most {LONGEST} characters, got {len(text)}")
    try:
        _require_plain(path, text)
        value = _LOADER(text).get_single_data()
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line if error.problem_mark else None
        raise _refused(path, f"must be YAML, got: {error.problem}", line) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: an impossible date
        raise _refused(path, f"must be YAML, got: {str(error)[:300]}") from None
    return Node(path, "", value)


def _require_plain(path: Path, text: str) -> None:
    """Refuse what a small file can say much with, or say twice, before anything is made of it.

    Raises:
        SceneError: Names the line.
    """
    around: list[_Collection] = []
    for event in yaml.parse(text, _LOADER):
        line = event.start_mark.line
        if isinstance(event, yaml.AliasEvent):
            raise _refused(path, f"must have no aliases, got *{event.anchor}", line)
        if isinstance(event, yaml.CollectionEndEvent):
            around.pop()
        elif isinstance(event, yaml.NodeEvent) and around and around[-1].is_mapping:
            inside = around[-1]
            inside.count += 1
            if inside.count % 2 and isinstance(event, yaml.ScalarEvent):
                if event.value in inside.keys:
                    raise _refused(path, f"must have every key once, got {event.value!r}", line)
                inside.keys.add(event.value)
        if isinstance(event, yaml.CollectionStartEvent):
            around.append(_Collection(isinstance(event, yaml.MappingStartEvent)))
            if len(around) > DEEPEST:
                raise _refused(path, f"must have at most {DEEPEST} levels, got more", line)


@dataclass
class _Collection:
    """A list or a mapping that is being read."""

    is_mapping: bool
    count: int = 0
    """Keys and values of a mapping so far."""
    keys: set[str] = field(default_factory=set)


def _refused(path: Path, what: str, line: int | None = None) -> SceneError:
    return SceneError(Fault(str(path), what, "", "" if line is None else f"line {line + 1}"))
