"""Records the configuration of a run without the folders and the user's name of this machine.

A path below the results folder becomes ``${results}/...``, one below the current folder becomes relative, one in the user's home
begins with ``~``; of any other absolute path only the last part is kept. `found_again` turns recorded paths into real ones.
"""

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from vlgs.files import write_atomically, write_changed

_PATH = re.compile(r"""((?:[=,\[]|file:/)['"]?/?)(/[^,'"\]]+)""")
"""An absolute path inside a longer text, and what stands before it."""


def record(config: DictConfig) -> dict[str, Any]:
    """The resolved configuration as config.yaml and the checkpoints have it.

    Example:
        >>> record(OmegaConf.create({"results": "/a/b", "cache": "${results}/c", "root": "/d/e", "level": 3}))
        {'results': 'b', 'cache': '${results}/c', 'root': 'e', 'level': 3}
    """
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    results = str(plain.get("results", ""))
    content = without_places(plain, {results: "${results}"} if os.path.isabs(results) else {})
    if os.path.isabs(results):
        content["results"] = without_places(results)
    return content


def write_config(path: Path, content: Mapping[str, Any]) -> None:
    """Write config.yaml: what `record` returned."""
    write_atomically(path, OmegaConf.to_yaml(OmegaConf.create(dict(content))).encode())


def found_again(folder: Path) -> DictConfig:
    """The configuration in a run folder, with the results folder that it lies in and the home of whoever opens it."""
    config = OmegaConf.load(folder / "config.yaml")
    assert isinstance(config, DictConfig)
    home = OmegaConf.create(_each(OmegaConf.to_container(config), os.path.expanduser))
    assert isinstance(home, DictConfig)
    home["results"] = str(folder.parents[1])
    return home


def tidy_sweep(folder: Path) -> None:
    """Take the places out of Hydra's own record of a sweep, which it writes before the first run."""
    path = folder / "multirun.yaml"
    if path.is_file():
        tidy = OmegaConf.create(without_places(OmegaConf.to_container(OmegaConf.load(path))))
        write_changed(path, OmegaConf.to_yaml(tidy).encode())


def without_places(content: Any, named: Mapping[str, str] | None = None) -> Any:
    """Dictionaries, lists and strings as JSON and YAML have them, with absolute paths shortened.

    Args:
        content: What may hold paths: whole strings, values of overrides (``data.root=/a/b``), ``file://`` addresses.
        named: Folder -> what it is called, before the current folder and the home.
    """
    known = {**(named or {}), os.getcwd(): ".", os.path.expanduser("~"): "~"}

    def short(path: str) -> str:
        path = os.path.normpath(path)
        for folder, name in known.items():
            if folder != "/" and Path(path).is_relative_to(folder):
                return os.path.normpath(f"{name}/{path[len(os.path.normpath(folder)) :]}")
        return os.path.basename(path)

    def shorten(text: str) -> str:
        if os.path.isabs(text):
            return short(text)
        return _PATH.sub(lambda match: match[1] + short(match[2]), text)

    return _each(content, shorten)


def _each(content: Any, change: Callable[[str], str]) -> Any:
    """Every string replaced; keys stay."""
    if isinstance(content, dict):
        return {key: _each(value, change) for key, value in content.items()}
    if isinstance(content, list):
        return [_each(value, change) for value in content]
    return change(content) if isinstance(content, str) else content
