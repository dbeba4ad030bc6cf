"""Run folders from when an id was a hash of class paths: found, renamed and gone on with. Imports no torch.

The id that a folder had follows from where the classes stood then, so that this finds nothing more once they are moved; it can go then.
"""

import hashlib
import json
import logging
from collections.abc import Collection
from typing import Any

from omegaconf import DictConfig, OmegaConf

from vlgs.files import write_atomically
from vlgs.identity import GIVEN_FILES, RESULTS_VERSION, identity
from vlgs.runs import RunFolder

log = logging.getLogger(__name__)

_UNCOUNTED = frozenset(
    {"data", "features", "hydra", "logger", "on_existing", "pictures"}
    | {"plugins", "progress", "results", "threads"}
)


def adopt(folder: RunFolder, config: DictConfig, content: str) -> None:
    """Rename the folder that this very run was given under its former id, if there is one and no other has taken its place.

    Args:
        folder: Of the run, under the id that it has now.
        config: Of the run.
        content: What stands for its data, as in `vlgs.identity.run_id`.

    Raises:
        BlockingIOError: If another process is writing to it.
        ValueError: If its metrics.json is damaged; it says what to do.
    """
    former = RunFolder(folder.path.with_name(former_id(config, content)))
    if folder.path.exists() or not former.config.is_file():
        return
    with former.writing():
        metrics = former.finished()
        if metrics is not None:
            known = identity(config)
            names = {
                "config_hash": folder.path.name,
                "recipe": known.recipe,
                "data_recipe": known.data,
            }
            write_atomically(former.metrics, json.dumps(metrics | names, indent=2).encode())
        former.path.rename(folder.path)
    log.info(
        "%s is %s now: the ids of runs no longer change when a class is moved",
        former.path,
        folder.path,
    )


def former_id(config: DictConfig, content: str) -> str:
    """The id of a run as it was until ids named options."""
    plain: Any = OmegaConf.to_container(config, resolve=True)
    kept = {str(key): value for key, value in plain.items() if key not in _UNCOUNTED}
    for group, key in (*GIVEN_FILES, ("codec", "cache_dir")):
        kept[group].pop(key, None)
    kept["augment"] = _without(kept["augment"], {"weights", "device"})
    hashed = {"config": kept, "data": content, "results_version": RESULTS_VERSION}
    text = json.dumps(hashed, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _without(node: Any, keys: Collection[str]) -> Any:
    if isinstance(node, dict):
        return {key: _without(value, keys) for key, value in node.items() if key not in keys}
    return node
