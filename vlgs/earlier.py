"""Reads a configuration that an earlier version recorded, in which classes stand where they stood then. Imports no torch.

Resuming composes a new configuration and finds its folder by the id, which holds no class path. Whoever is given a folder has nothing but
its config.yaml.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from vlgs.identity import AS_WITHOUT
from vlgs.known import (
    CONF,
    chosen,
    groups,
    is_ours,
    join,
    last,
    nodes,
    option,
    renamed,
    targets,
    unread,
)

FORMER_CLASSES: Mapping[str, str] = {
    "ColourOpacity": "Opacity",
    "Faults": "LabelNoise",
    "Sharing": "choose_sharing",
}
"""Name of a class, or of a function in its place, -> what it is called now. One that only moved is found by its name."""


def as_today(recorded: DictConfig) -> DictConfig:
    """What a recorded configuration says, in today's words: what was recorded, over the chosen options as they are now.

    A key that came later gets the value with which everything is as it was before (`vlgs.identity.AS_WITHOUT`). A key that is read no
    more is left out.

    Raises:
        ValueError: If a class of ours is named that there is no more.
    """
    plain: dict[str, Any] = {}
    for key, value in _leaves(OmegaConf.to_container(recorded, resolve=True)):
        _put(plain, renamed(key) or key, value)
    before = {key for key, _ in _leaves(plain)}
    for key, node in list(nodes(plain)):
        if "_target_" in node:
            _set_target(key, node)
    for key, _ in list(unread(plain)):
        _drop(plain, key)
    options, foreign = _options(plain)
    always = chosen()  # any other group has to be added
    asked = [f"{'' if g in always else '+'}{g}={name}" for g, name in options.items()]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", asked)
    OmegaConf.set_struct(config, False)
    for group in foreign:
        config[group] = {}  # the arguments of the default are not its own
    for key, value in AS_WITHOUT.items():
        above = key.rpartition(".")[0]
        there = not above or OmegaConf.select(config, above) is not None
        if value is not True and key not in before and there:
            OmegaConf.update(config, key, value)
    merged = OmegaConf.merge(config, plain)
    assert isinstance(merged, DictConfig)
    return merged


def _leaves(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of all that is no mapping; an empty mapping is a value."""
    if isinstance(node, Mapping) and node:
        for name, child in node.items():
            yield from _leaves(child, join(key, name))
    else:
        yield key, node


def _put(plain: dict[str, Any], key: str, value: Any) -> None:
    *above, name = key.split(".")
    for each in above:
        plain = plain.setdefault(each, {})
    plain[name] = value


def _drop(plain: dict[str, Any], key: str) -> None:
    *above, name = key.split(".")
    for each in above:
        plain = plain[each]
    plain.pop(name, None)


def _set_target(key: str, node: Any) -> None:
    """Put the class of today in the place of one that moved, or nothing where no class stands any more."""
    target = str(node["_target_"])
    if not target.startswith("vlgs.") or is_ours(target):
        return
    name = target.rpartition(".")[2]
    name = FORMER_CLASSES.get(name, name)
    found = [each for each in targets(last(key)) if each.rpartition(".")[2] == name]
    if len(found) == 1:
        node["_target_"] = found[0]
    elif targets(last(key)):
        raise ValueError(
            f"config: {join(key, '_target_')} must be a class of this version, got {target}"
        )
    else:
        del node["_target_"]


def _options(plain: Mapping[str, Any]) -> tuple[dict[str, str], list[str]]:
    """Group -> the option whose class stands there; groups at which a class of somebody else stands."""
    chosen, foreign = {}, []
    for group in sorted(groups() & set(plain)):
        target = (plain[group] or {}).get("_target_")
        name = option(group, target) if target else None
        if name is not None:
            chosen[group] = name
        elif target:
            foreign.append(group)
    return chosen, foreign
