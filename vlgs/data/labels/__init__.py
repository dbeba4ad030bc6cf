"""Labels of views: objects (LERF-OVS polygons, folders of masks) and dense class ids; the folder tells which."""

from pathlib import Path

from vlgs.data.diagnostics import Fault
from vlgs.data.labels.dense import DenseFolder, open_dense
from vlgs.data.labels.folders import open_class_folders, open_prompt_folders
from vlgs.data.labels.objects import ObjectFolder, open_objects

__all__ = ["DenseFolder", "ObjectFolder", "open_labels"]


def open_labels(folder: Path) -> tuple[DenseFolder | ObjectFolder | None, tuple[Fault, ...]]:
    """Read what a label folder says about itself; the pixels of dense labels stay on disk.

    Args:
        folder: ``classes.json`` and ``<stem>.png``; or ``classes.txt`` and ``<stem>/<class>.png`` (3D-OVS); or one
            ``<stem>.json`` per labelled image (LERF-OVS); or ``<prompt>/masks/<stem>.png`` (GOI).

    Returns:
        The folder, None if it is neither, and everything wrong with it.
    """
    if (folder / "classes.json").is_file():
        return open_dense(folder)
    if (folder / "classes.txt").is_file():
        return open_class_folders(folder)
    if any(folder.glob("*.json")):
        return open_objects(folder)
    if any(folder.glob("*/masks")):
        return open_prompt_folders(folder)
    what = (
        "labels must be <stem>.json files (LERF-OVS), or classes.json and <stem>.png files, or classes.txt and "
        "<stem>/<class>.png files (3D-OVS), or <prompt>/masks/<stem>.png files (GOI), got none of these"
    )
    return None, (Fault(str(folder), what),)
