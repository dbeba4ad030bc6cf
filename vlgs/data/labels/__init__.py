"""Labels of views, in the two layouts that are in use: LERF-OVS objects and dense class ids."""

from pathlib import Path

from vlgs.data.faults import Fault
from vlgs.data.labels.dense import DenseFolder, open_dense
from vlgs.data.labels.objects import ObjectFolder, open_objects

__all__ = ["DenseFolder", "ObjectFolder", "open_labels"]


def open_labels(folder: Path) -> tuple[DenseFolder | ObjectFolder | None, tuple[Fault, ...]]:
    """Read what a label folder says about itself; the pixels of dense labels stay on disk.

    Args:
        folder: Either ``classes.json`` and ``<stem>.png``, or one ``<stem>.json`` per labelled image (S. C.2).

    Returns:
        The folder, None if it is neither, and everything wrong with it.
    """
    if (folder / "classes.json").is_file():
        return open_dense(folder)
    if any(folder.glob("*.json")):
        return open_objects(folder)
    what = "labels must be <stem>.json files (LERF-OVS), or classes.json and <stem>.png files, got neither"
    return None, (Fault(str(folder), what),)
