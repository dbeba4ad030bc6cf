"""Checks the command line of `vlgs.run` and `vlgs.check` before Hydra sees it: a mistake gives one line that suggests what was meant. Imports no torch.

Hydra alone would answer ``trainr=photos`` with the advice to write ``+trainr=photos``, which it then accepts and ignores. It also constructs
callbacks and loggers before a task begins. Therefore the configuration is composed and checked here first.
"""

import sys
from collections.abc import Collection, Iterator, Sequence
from functools import cache
from pathlib import Path
from string import Template
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vlgs.config import check_targets
from vlgs.known import CONF, contents, groups, join, near, options, place, renamed
from vlgs.manual import describe
from vlgs.targets import check_hydra, require_importable, require_plugins

_MOST_ENTRIES = 10_000
"""Of a user's file of options; none of ours has a hundred."""
_REFUSED_FLAGS = {
    "experimental_rerun": "--experimental-rerun must not be given, as it runs what is pickled in a file",
    "config_path": "--config-path must not be given, as the configuration is that of vlgs; --config-dir=FOLDER adds options to it",
    "config_name": "--config-name must not be given, as the configuration is that of vlgs; --config-dir=FOLDER adds options to it",
}


def check_command(arguments: Sequence[str], name: str = "config") -> DictConfig | None:
    """Refuse a command line with mistakes, or one that would run foreign code before the task begins.

    ``--help`` prints the manual, or with options (``data=colmap``) the keys of these, and exits.

    Args:
        arguments: Without the program.
        name: Of the primary file in `conf`.

    Returns:
        The configuration with Hydra's part, where one run is asked for and nothing else of Hydra (`vlgs.task.run_task`); else None.

    Raises:
        ValueError: Names the argument, and what could have been meant.
    """
    parser = get_args_parser()
    given = parser.parse_args(list(arguments))
    for flag, why in _REFUSED_FLAGS.items():
        if getattr(given, flag):
            raise ValueError(f"command: {why}, got {getattr(given, flag)}")
    extra = Path(given.config_dir).resolve() if given.config_dir else None
    if extra is not None:
        _check_folder(extra)
    overrides = _parse(given.overrides)
    _check_overrides(overrides, extra, name)
    for override in overrides:
        if override.is_sweep_override() and not given.multirun:
            raise ValueError(
                f"command: several values must be given with -m, one run for each; a list in brackets, a text in quotes, got {override.input_line}"
            )
    if given.help:
        chosen = [o for o in overrides if o.key_or_group in groups()]
        for override in chosen:
            print(describe(override.key_or_group, str(override.value())))
        if not chosen:
            print(_manual(_compose(given.overrides, name, extra, hydra=True), extra, given.resolve))
        sys.exit(0)
    if given.hydra_help or given.shell_completion:
        return None
    config = None
    for job in _jobs(overrides):
        config = _compose(job, name, extra, hydra=True)
        check_hydra(_plain(config.hydra))
        _check_plugins(config, overrides)
        own = [str(key) for key in config if key != "hydra"]
        check_targets(OmegaConf.masked_copy(config, own), name)
    is_plain = vars(given) == vars(parser.parse_args(given.overrides))
    return config if is_plain and config is not None and config.hydra.mode is None else None


def composed(overrides: Sequence[str], name: str = "config") -> DictConfig:
    """The configuration of a command line, checked in the same way, for commands that start runs themselves.

    Raises:
        ValueError: As `check_command`.
    """
    _check_overrides(_parse(overrides), None, name)
    config = _compose(overrides, name, None, hydra=False)
    check_targets(config, name)
    return config


def _manual(config: DictConfig, extra: Path | None, resolve: bool) -> str:
    """The text of ``--help``. Hydra would fill it in with the same, and copy all that it has read for every group that it lists."""
    own = [str(key) for key in config if key != "hydra"]
    keys = OmegaConf.to_yaml(OmegaConf.masked_copy(config, own), resolve=resolve)
    folders = {path.parent for path in extra.rglob("*.yaml")} - {extra} if extra else set()
    known = groups() | {folder.relative_to(extra).as_posix() for folder in folders if extra}
    listed = [f"{group}: {', '.join(_options(group, extra))}\n" for group in sorted(known)]
    return Template(config.hydra.help.template).substitute(
        APP_CONFIG_GROUPS="".join(listed), CONFIG=keys
    )


def _parse(overrides: Sequence[str]) -> list[Override]:
    for text in overrides:
        if text.startswith("=") or not text.partition("=")[0].strip():
            raise ValueError(f"command: arguments must be KEY=VALUE, got {text!r}")
    parser = OverridesParser.create()
    parsed = []
    for text in overrides:
        try:
            parsed.append(parser.parse_override(text))
        except ValueError as error:  # of Python, about a number of thousands of digits
            what = f"{text.partition('=')[0]} must be a value that can be read, got: {error}"
            raise ValueError(f"command: {what}") from error
        except HydraException as error:  # of the parser, or of its lexer
            key, equals, value = text.partition("=")
            hint = (
                f"; quote what has blanks, brackets or commas: \"{key}='{value}'\""
                if equals
                else ""
            )
            raise ValueError(f"command: arguments must be KEY=VALUE, got {text!r}{hint}") from error
    return parsed


def _check_overrides(overrides: Sequence[Override], extra: Path | None, name: str) -> None:
    """Refuse options that do not exist and overrides that delete keys. Whether keys exist is checked after composing."""
    chosen = {
        next(iter(entry))
        for entry in contents(CONF / f"{name}.yaml")["defaults"]
        if isinstance(entry, dict)
    }
    for override in overrides:
        key, said = override.key_or_group, override.input_line
        if (now := renamed(key)) is not None:
            raise ValueError(f"command: {key} must be given as {now}, its new name, got {said}")
        if override.type == OverrideType.DEL:
            raise ValueError(
                f"command: keys must be given or left alone, got {said}, which takes {key} away"
            )
        if override.package is not None:
            raise ValueError(f"command: options must be given as {key}=OPTION, got {said}")
        if key in chosen and override.type != OverrideType.CHANGE:
            # Hydra keeps the option that the file or another argument has chosen, and says nothing.
            raise ValueError(f"command: {key} must be given without +, got {said}")
        if key == "hydra.searchpath":
            raise ValueError(f"command: folders must be given as --config-dir=FOLDER, got {said}")
        known = _options(key, extra)
        if not known:
            continue
        for choice in _choices(override):
            if choice not in known:
                meant = near(str(choice), known)
                hint = f"; did you mean {' or '.join(meant)}?" if meant else ""
                raise ValueError(
                    f"config: {key} must be one of {', '.join(known)}, got {choice}{hint}"
                )


def _options(group: str, extra: Path | None) -> list[str]:
    """Options of a group, with those of the user's own folder; none where a key is no group."""
    own = sorted(path.stem for path in (extra / group).glob("*.yaml")) if extra else []
    return [*(options(group) if group in groups() else []), *own]


def _choices(override: Override) -> list[Any]:
    """Values that an override goes through: one, or those of a sweep."""
    if not override.is_sweep_override():
        return [override.value()]
    if not override.is_discrete_sweep():
        return []
    return [_literal(value) for value in override.sweep_string_iterator()]


def _literal(text: object) -> str:
    return str(text).strip("'\"")


def _jobs(overrides: Sequence[Override]) -> Iterator[list[str]]:
    """Command lines that between them have every value of a sweep once."""
    several = [
        [f"{o.get_key_element()}={value}" for value in o.sweep_string_iterator()]
        if o.is_sweep_override() and o.is_discrete_sweep()
        else [str(o.input_line)]
        for o in overrides
        if not o.is_sweep_override() or o.is_discrete_sweep()
    ]
    first = [values[0] for values in several]
    yield first
    for index, values in enumerate(several):
        for value in values[1:]:
            yield [*first[:index], value, *first[index + 1 :]]


def _compose(overrides: Sequence[str], name: str, extra: Path | None, hydra: bool) -> DictConfig:
    """Compose a command line; an error suggests what was meant."""
    path = [f"hydra.searchpath=[file://{extra}]"] if extra else []
    try:
        with initialize_config_dir(str(CONF), job_name="run", version_base="1.3"):
            return compose(name, overrides=[*path, *overrides], return_hydra_config=hydra)
    except (
        HydraException,
        OmegaConfBaseException,
        AttributeError,
    ) as error:  # OmegaConf's own slip
        parsed = _parse(overrides)
        _explain(parsed, name, extra)
        reason = str(error).strip().partition("\n")[0]
        raise ValueError(
            f"command: {' '.join(overrides)} must be a configuration, got: {reason}"
        ) from error


def _explain(overrides: Sequence[Override], name: str, extra: Path | None) -> None:
    """Raise our own error for the first key that does not exist."""
    chosen = tuple(str(o.input_line) for o in overrides if _options(o.key_or_group, extra))
    try:
        known = _keys(name, chosen)
    except HydraException:
        return  # an option of a group that nothing brings, such as lift without method=lift: Hydra says so
    for override in overrides:
        key = override.key_or_group
        if override.input_line in chosen or key.startswith("hydra"):
            continue
        if override.type == OverrideType.ADD and key in known:
            raise ValueError(f"command: {key} must be given without +, got {override.input_line}")
        if override.type == OverrideType.CHANGE and key not in known:
            hint = _elsewhere(key) or _meant(key, known)
            raise ValueError(f"config: {key} must be a key, got one that is not there{hint}")


def _elsewhere(key: str) -> str:
    """Which options of the group have the key, if the one that was chosen has not."""
    group, dot, _ = key.partition(".")
    having = [o for o in options(group) if key in _keys_of(group, o)] if group in groups() else []
    return f"; {group}={' or '.join(having[:4])} has it" if dot and having else ""


def _meant(key: str, known: Collection[str]) -> str:
    """Similar names: keys beside it, keys of other options of its group, and groups."""
    above, dot, word = key.rpartition(".")
    group = above.partition(".")[0]
    every = {k for o in options(group) for k in _keys_of(group, o)} if group in groups() else set()
    beside = {k.rpartition(".")[2] for k in {*known, *every} if k.rpartition(".")[0] == above}
    if not above:
        beside |= groups()
    beside = {name for name in beside if not name.startswith("_")}
    close = near(word, beside)
    if close:
        return f"; did you mean {' or '.join(above + dot + name for name in close)}?"
    return f"; {above} has {', '.join(sorted(beside))}" if above and beside else ""


@cache
def _keys(name: str, chosen: tuple[str, ...]) -> frozenset[str]:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose(name, overrides=list(chosen))
    return frozenset(_flat(OmegaConf.to_container(config, resolve=False), ""))


@cache
def _keys_of(group: str, option: str) -> frozenset[str]:
    path = CONF / group / f"{option}.yaml"
    return frozenset(_flat(contents(path), place(path)))


def _flat(node: Any, key: str) -> Iterator[str]:
    if key:
        yield key
    items = (
        node.items()
        if isinstance(node, dict)
        else enumerate(node)
        if isinstance(node, list)
        else ()
    )
    for name, child in items:
        yield from _flat(child, join(key, name))


def _check_plugins(config: DictConfig, overrides: Sequence[Override]) -> None:
    """Refuse trust in packages from files: only the command line may name plugins."""
    named = [o.value() for o in overrides if o.key_or_group == "plugins"]
    given = [str(package) for value in named for package in require_plugins(value)]
    stated = config.get("plugins", [])
    listed = _plain(stated) if isinstance(stated, ListConfig) else stated
    for package in require_plugins(listed):
        if package not in given:
            raise ValueError(
                f"config: plugins must be given on the command line, as plugins=[{package}], got {package} from a file"
            )
    require_importable(given)


def _check_folder(folder: Path) -> None:
    """Refuse an option folder that changes Hydra's own settings or names plugins."""
    if not folder.is_dir():
        raise ValueError(f"command: --config-dir must be a folder, got {folder}")
    for path in sorted((*folder.rglob("*.yaml"), *folder.rglob("*.yml"))):
        if not path.is_file():  # a pipe would be waited for without end
            raise ValueError(f"{path}: must be a file, got a folder or a device")
        try:
            text = path.read_text(encoding="utf-8")
            content = yaml.safe_load(text) or {}
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            raise ValueError(
                f"{path}: content must be YAML in UTF-8, got {error}".replace("\n", " ")
            ) from error
        if not isinstance(content, dict) or _entries(content) > _MOST_ENTRIES:
            raise ValueError(
                f"{path}: content must be keys and values, at most {_MOST_ENTRIES}, got something else or more"
            )
        names = set(content)
        header = [line for line in text.splitlines() if line.startswith("#") and "@package" in line]
        defaults = str(content.get("defaults", ""))
        inside = "hydra" in path.relative_to(folder).parts
        if inside or names & {"hydra", "plugins"} or "hydra" in " ".join([*header, defaults]):
            raise ValueError(
                f"{path}: options must leave hydra and plugins alone; give what is needed on the command line"
            )


def _entries(content: Any) -> int:
    """Values inside, those under an alias as often as it stands there, which a small file can do very often; stops where enough."""
    count, waiting = 0, [content]
    while waiting and count <= _MOST_ENTRIES:
        node = waiting.pop()
        inside = list(
            node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
        )
        count += len(inside)
        waiting += inside
    return count


def _plain(node: Any) -> Any:
    return OmegaConf.to_container(node, resolve=False)
