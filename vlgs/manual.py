"""The text of `--help` for an option: its keys, their defaults and the comments of its file. Imports no torch."""

import re
from collections.abc import Iterator

from vlgs.known import CONF, contents, options, place

_KEY = re.compile(r"^(?P<indent> *)(?P<name>[\w$]+):(?P<value>(?: [^#]*)?)(?:# ?(?P<note>.*))?$")


def describe(group: str, option: str) -> str:
    """The keys of one option as they stand on a command line.

    Example:
        >>> print(describe("fusion", "mlp"))
        fusion=mlp
          fusion.color_dim=3
          fusion.feature_dim=${code_channels:${levels},${head.dim}}
          fusion.residual=true
    """
    about = _about(group, option)
    keys = dict(_keys(group, option))
    width = min(44, max((len(f"{key}={value}") for key, (value, _) in keys.items()), default=0))
    rows = []
    for key, (value, note) in keys.items():
        pair = f"{key}={value}"
        rows.append(f"  {pair:<{width}}  {note}".rstrip())
    return "\n".join([f"{group}={option}", *(f"  {line}" for line in about), *rows])


def list_options(group: str) -> str:
    """A line for each option of a group, its name and how its file begins, as they stand in the text of ``--help``."""
    known = {name: _about(group, name)[0] for name in options(group)}
    width = max(map(len, known))
    return "\n    ".join(f"{name:<{width}}  {line}" for name, line in known.items())


def _about(group: str, option: str) -> list[str]:
    """Comments of an option's file that stand on lines of their own."""
    path = CONF / group / f"{option}.yaml"
    if not path.is_file():
        return ["An option of your own: its file has the keys."]
    lines = path.read_text().splitlines()
    return [line[2:] for line in lines if line.startswith("# ") and "@package" not in line]


def _keys(group: str, option: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Key -> value and comment, first those of the options that this one is made from."""
    path = CONF / group / f"{option}.yaml"
    if not path.is_file():
        return
    for entry in contents(path).get("defaults", []):
        if isinstance(entry, str) and entry != "_self_":
            yield from _keys(group, entry.partition("@")[0])
    root, parents, skipping = place(path), list[tuple[int, str]](), False
    for line in path.read_text().splitlines():
        found = _KEY.match(line)
        if not line.startswith(" "):
            skipping = line.startswith("defaults:")
        if found is None or skipping:
            continue
        indent = len(found["indent"])
        parents = [(depth, name) for depth, name in parents if depth < indent]
        names = [name for name in (root, *(name for _, name in parents), found["name"]) if name]
        value, note = found["value"].strip(), found["note"] or ""
        if not value:
            parents.append((indent, found["name"]))
        elif found["name"] not in ("_target_", "_partial_") or value == "???":
            yield ".".join(names), (value, note)
