"""What is in `conf`: groups and options, the keys that exist, and the targets that may be constructed. Imports no torch.

A file of `conf` mirrors the arguments of the class that it names, so that these files are the schema of the configuration.
"""

import difflib
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

_INSIDE = Path(__file__).resolve().parent / "conf"
CONF = _INSIDE if (_INSIDE / "config.yaml").is_file() else _INSIDE.parents[1] / "conf"
"""Folder of the configuration: inside the package in an installed wheel, beside it in a checkout. What lies beside an installed
package (``site-packages/conf``) is somebody else's."""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""In C where PyYAML has it: every command reads all of `conf`."""

OPEN = frozenset({"gaussians.attributes", "loss"})
"""Keys whose children a user names: objectives, further attributes of a Gaussian."""

FORMER: Mapping[str, str] = {
    "head": "codec",
    "loss.photometric.error": "loss.rgb_loss",
    "loss.language.error": "loss.lang_loss",
    "loss.language.pixels": "loss.lang_pixels",
    "loss.blended_view.weight": "loss.blend_weight",
}
"""Key, with all that is below it -> what it was called before. Ids of runs have the old name; whoever writes it is told the new one."""

_LOGGERS = frozenset(
    f"lightning.pytorch.loggers.{name}Logger"
    for name in ("CSV", "Comet", "MLFlow", "Neptune", "TensorBoard", "Wandb")
)
"""Lightning's own, whose arguments are theirs to check."""

_SHARED = "not an option by itself"
"""Comment of a file that others are made from."""

_PACKAGE = re.compile(r"^# @package (\S+)", re.MULTILINE)


@dataclass(frozen=True)
class _Schema:
    """All that the files say; keys are dotted and start at the root."""

    targets: Mapping[str, frozenset[str]]
    arguments: Mapping[str, frozenset[str]]
    keys: frozenset[str]
    naming: Mapping[tuple[str, str], tuple[Path, ...]]
    """(last name of a group, target) -> files of the group that say it, in alphabetical order."""


def targets(name: str) -> frozenset[str]:
    """Parts of ours that may stand at a key of this name: those that stand there in `conf`.

    Example:
        >>> sorted(targets("indicator"))[0]
        'vlgs.indicator.Fixed'
    """
    return _schema().targets.get(name, frozenset())


def option(key: str, target: str, folders: Collection[Path] = ()) -> str | None:
    """The option that constructs a class at a key: the one file of the key's group that names the class.

    Args:
        key: Dotted; its last name is the group's: ``fusion``, ``augment.extractor.encoder``.
        target: Of the class.
        folders: Further ones with options, of the user's own. Theirs is no name that one of ours has.

    Returns:
        None where no file names it.

    Raises:
        ValueError: If several files do, so that none of them is the option's name.

    Example:
        >>> option("fusion", "vlgs.fusion.mlp.MLP")
        'mlp'
    """
    group = last(key)
    naming = _schema().naming
    files = naming.get((group, target), ())
    if not files:
        taken = {path.stem for (own, _), ours in naming.items() if own == group for path in ours}
        theirs = (path for folder in folders for path in sorted(folder.rglob(f"{group}/*.yaml")))
        free = (path for path in theirs if path.stem not in taken)
        files = tuple(path for path in free if _says(contents(path), target))
    if len(files) > 1:
        raise ValueError(
            f"config: {target} must be named by one file of {files[0].parent}, got {' and '.join(path.name for path in files)}: the id "
            f"of a run has the file's name; begin the others with `defaults: [{files[0].stem}, _self_]`, and keep what differs"
        )
    return files[0].stem if files else None


def _says(content: Any, target: str) -> bool:
    return isinstance(content, Mapping) and content.get("_target_") == target


def is_group(key: str) -> bool:
    """Whether what stands at a key is chosen among options.

    Example:
        >>> is_group("fusion"), is_group("augment.extractor.encoder"), is_group("gaussians.densify")
        (True, True, False)
    """
    return last(key) in _group_names()


def is_ours(target: object) -> bool:
    """Whether a target stands in `conf`, wherever."""
    return any(target in [*names] for names in _schema().targets.values())


@cache
def groups() -> frozenset[str]:
    """Folders of options, without Hydra's own: ``data``, ``features/encoder``."""
    folders = {path.parent.relative_to(CONF).as_posix() for path in CONF.rglob("*.yaml")}
    return frozenset(f for f in folders if f != "." and f.partition("/")[0] != "hydra")


@cache
def _group_names() -> frozenset[str]:
    return frozenset(group.rpartition("/")[2] for group in groups())


def options(group: str) -> list[str]:
    """Names of the options of a group, in alphabetical order."""
    files = sorted((CONF / group).glob("*.yaml"))
    return [path.stem for path in files if _SHARED not in path.read_text()]


def unread(config: Mapping[str, Any], name: str = "config") -> Iterator[tuple[str, list[str]]]:
    """Keys of a configuration that nothing reads, each with the keys that could have been meant.

    Args:
        config: Plain.
        name: Of the primary file, which says what stands at the root.
    """
    top = _top(name)
    for key, value in config.items():
        if (now := renamed(str(key))) is not None:
            yield str(key), [now]
        elif key not in top:
            yield str(key), near(str(key), top | {g for g in groups() if "/" not in g})
        elif isinstance(value, Mapping | list):
            yield from _unread_in(str(key), value)


@cache
def former(key: str) -> str:
    """What a key was called before, or itself.

    Example:
        >>> former("loss.photometric.error"), former("fusion.width")
        ('loss.rgb_loss', 'fusion.width')
    """
    return next((old + key[len(new) :] for new, old in FORMER.items() if _below(key, new)), key)


def renamed(key: str) -> str | None:
    """What a key is called now that was called so before; None if none was."""
    return next((new + key[len(old) :] for new, old in FORMER.items() if _below(key, old)), None)


def _below(key: str, place: str) -> bool:
    return key == place or key.startswith(f"{place}.")


def near(word: str, words: Collection[str]) -> list[str]:
    """The words that a mistyped one could have been, the likeliest first."""
    return difflib.get_close_matches(word, sorted(words), n=3, cutoff=0.6)


def contents(path: Path) -> dict[str, Any]:
    """Content of a file of `conf`; empty for one of comments alone."""
    return _LOADER(path.read_text()).get_single_data() or {}


def place(path: Path) -> str:
    """Key under which the content of a file of `conf` goes: its group's, or that of its package line; empty for the root."""
    found = _PACKAGE.search(path.read_text())
    if found:
        return found[1].replace("_global_", "")
    folder = path.relative_to(CONF).parent
    return ".".join(folder.parts)


def nodes(node: Any, key: str = "") -> Iterator[tuple[str, Mapping[Any, Any]]]:
    """Every mapping inside, with its dotted key."""
    if isinstance(node, Mapping):
        yield key, node
        for name, child in node.items():
            yield from nodes(child, join(key, name))
    elif isinstance(node, list | tuple):
        for index, child in enumerate(node):
            yield from nodes(child, join(key, index))


def join(key: str, name: object) -> str:
    """A dotted key."""
    return f"{key}.{name}" if key else str(name)


def last(key: str) -> str:
    """The name in a dotted key that says what is expected there: the last one that is no index of a list."""
    names = [name for name in key.split(".") if not name.isdigit()]
    return names[-1] if names else ""


def _unread_in(key: str, node: Any) -> Iterator[tuple[str, list[str]]]:
    if isinstance(node, list):
        for index, child in enumerate(node):
            yield from _unread_in(join(key, index), child)
    if not isinstance(node, Mapping) or key == "data.release":
        return
    target = node.get("_target_")
    if target is not None and (not is_ours(target) or target in _LOGGERS):
        return  # somebody else's, whose constructor says what it takes
    known = _schema().arguments.get(str(target), frozenset()) | {"_target_", "_partial_"}
    if target is None:
        known = {k.rpartition(".")[2] for k in _schema().keys if k.rpartition(".")[0] == key}
    for name, child in node.items():
        if name not in known and not (key in OPEN and isinstance(child, Mapping)):
            now, meant = renamed(join(key, name)), near(str(name), known)
            if target is None and not meant and targets(last(key)):
                meant = ["_target_"]  # whose keys these are is what is missing
            yield join(key, name), [now] if now else [join(key, other) for other in meant]
        elif key != "gaussians.attributes":  # whose values `vlgs.gaussians.GaussiansConfig` judges
            yield from _unread_in(join(key, name), child)


@cache
def chosen(name: str = "config") -> frozenset[str]:
    """Groups of which a primary file always chooses an option.

    Example:
        >>> "fusion" in chosen(), "lift" in chosen()
        (True, False)
    """
    entries = contents(CONF / f"{name}.yaml")["defaults"]
    found = {str(group) for entry in entries if isinstance(entry, dict) for group in entry}
    return frozenset(group for group in found if not group.startswith("override "))


@cache
def _top(name: str) -> frozenset[str]:
    kept = set(contents(CONF / f"{name}.yaml")) - {"defaults", "hydra"}
    brought = {"features", "lift"}  # by augment=offline_sam and method=lift
    return frozenset(kept | chosen(name) | brought)


def _places(path: Path, defaults: Iterable[Any]) -> Iterator[str]:
    """Keys that the options fill which a file of `conf` chooses from groups below its own."""
    for entry in defaults:
        for group, option in entry.items() if isinstance(entry, Mapping) else ():
            file = path.parent / str(group) / f"{option}.yaml"
            if file.is_file():
                yield place(file)


@cache
def _schema() -> _Schema:
    found: dict[str, set[str]] = defaultdict(set, loggers=set(_LOGGERS))
    names: dict[str, set[str]] = defaultdict(set)
    at: dict[str, set[str]] = defaultdict(set)  # key -> targets that stand there
    keys: set[str] = set()
    naming: dict[tuple[str, str], tuple[Path, ...]] = defaultdict(tuple)
    files = [path for path in CONF.rglob("*.yaml") if path.relative_to(CONF).parts[0] != "hydra"]
    read = [(path, *pair) for path in sorted(files) for pair in nodes(contents(path), place(path))]
    every = [(key, node) for _, key, node in read]
    here: dict[tuple[Path, str], str] = {}
    for path, key, node in read:
        if "_target_" in node:
            here[path, key] = node["_target_"]
            if path.parent.name == last(key):
                naming[last(key), node["_target_"]] += (path,)
    for path, _, node in read:
        for filled in _places(path, node.get("defaults") or ()):
            whole, _, name = filled.rpartition(".")
            if (path, whole) in here:
                names[here[path, whole]].add(name)
    for key, node in every:
        keys |= {key, *(join(key, name) for name in node if name != "defaults")}
        target = node.get("_target_")
        if isinstance(target, str) and target != "???":
            found[last(key)].add(target)
            at[key].add(target)
            names[target] |= set(node)
    for key, node in every:  # options that change a few arguments of another: trainer.iterations
        for target in at[key] if "_target_" not in node else ():
            names[target] |= set(node)
    return _Schema(
        {key: frozenset(values) for key, values in found.items()},
        {key: frozenset(values) - {"defaults"} for key, values in names.items()},
        frozenset(keys),
        naming,
    )
