"""Models of a finished run that differs in its questions or scores alone: taken, not trained again.

Such runs have the same models, bit for bit (`vlgs.identity.trained_id`). Checkpoints are linked into the folder of the new run, whose stages then
find every model finished, as those of a run do that was stopped after its last step.
"""

import logging
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

from vlgs.files import write_atomically
from vlgs.finished import read_finished
from vlgs.report.provenance import machine
from vlgs.runs import RunFolder

log = logging.getLogger(__name__)

_CHECKPOINTS = "checkpoint"
_ADDED_MAPS = "augment/language/*.npz"
"""Language maps of views that ``augment=offline_sam`` adds."""


def take_training(folder: RunFolder, trained_id: str) -> dict[str, Any] | None:
    """Link the models of a finished run with the same training into one that begins, where there is such a run beside it.

    It must have been made on this machine with as many threads, as the time of training is part of a run's results.

    Args:
        folder: Of the run that begins; left as it is if anything was trained in it.
        trained_id: Of that run.

    Returns:
        The metrics of the run whose models are there now; None if there are none.
    """
    if any(folder.path.rglob(_CHECKPOINTS)):
        return None
    for path in sorted(folder.path.parent.glob("*/metrics.json")):
        with suppress(OSError, ValueError):  # what is damaged, or just deleted, is no model
            if trained_id.encode() not in path.read_bytes():  # of a thousand runs few are parsed
                continue
            metrics = read_finished(path)
            if metrics.get("training") == trained_id and metrics.get("machine") == machine():
                _link(path.parent, folder)
                log.info("trained before, in %s: only asked and scored now", path.parent)
                return metrics
    return None


def _link(source: Path, folder: RunFolder) -> None:
    """Checkpoints are never written to, so that both runs may have the same file; a log would be."""
    for maps in sorted(source.glob(_ADDED_MAPS)):
        _share(maps, folder.path / maps.relative_to(source))
    for checkpoints in sorted(source.rglob(_CHECKPOINTS)):
        part = folder.part(str(checkpoints.parent.relative_to(source)))
        part.checkpoint.mkdir(parents=True)
        log = RunFolder(checkpoints.parent).curves
        if log.is_file():
            write_atomically(part.curves, log.read_bytes())
        for path in checkpoints.glob("*.safetensors"):
            _share(path, part.checkpoint / path.name)


def _share(path: Path, other: Path) -> None:
    other.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(path, other)
    except OSError:  # another file system, or one without links
        shutil.copy2(path, other)
