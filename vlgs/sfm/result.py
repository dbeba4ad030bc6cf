"""What came out of a reconstruction, as ``sfm.json`` keeps it beside the scene."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlgs.data.diagnostics import listing

REPORT = "sfm.json"


@dataclass(frozen=True)
class Reconstruction:
    """What came out."""

    photographs: int
    registered: int
    points: int
    reprojection_error: float
    """Mean over the points, in pixels."""
    apart: Sequence[int]
    """Photographs in each further part that fit together, but not with the scene, which is the largest part."""
    missing: Sequence[str]
    """Names of the photographs without a camera."""
    cameras: int
    """Whose lens was calibrated."""
    devices: int
    """Sizes and cameras that the files tell apart."""


def count_apart(registered: set[str], parts: Sequence[set[str]]) -> tuple[int, ...]:
    """Sizes of the further parts, without the photographs that the scene or a larger part has: COLMAP's parts overlap."""
    seen, sizes = set(registered), []
    for part in sorted(parts, key=len, reverse=True):
        if left := part - seen:
            sizes.append(len(left))
            seen |= left
    return tuple(sizes)


def read_finished(out: Path, made: dict[str, Any]) -> Reconstruction | None:
    """What an earlier call made in a folder; None where the folder is empty.

    Args:
        out: The folder.
        made: Options, and the photographs' names and digest. Scenes of earlier versions have no digest; there the names count.

    Raises:
        FileExistsError: If it holds anything else, or was made from other photographs or with other options.
    """
    if out.is_dir() and not any(out.iterdir()):
        return None
    try:
        report = json.loads((out / REPORT).read_text(encoding="utf-8"))
        before = report.pop("made")
        found = Reconstruction(**report)
        options, names = dict(before["options"]), list(before["names"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        what = "a folder with files" if out.is_dir() else "a file"
        raise FileExistsError(
            f"sfm: {out} must not exist, be empty or a scene that this command made, got {what}; choose another OUT"
        ) from None
    changed = [
        f"{key} {options.get(key)}, now {value}"
        for key, value in made["options"].items()
        if options.get(key) != value
    ]
    if names != made["names"]:
        changed.insert(0, f"{len(names)} photographs, now {len(made['names'])} or others")
    elif before.get("photographs", made["photographs"]) != made["photographs"]:
        changed.insert(0, "other photographs of the same names")
    if changed:
        raise FileExistsError(
            f"sfm: {out} must be made from the same photographs with the same options, got {listing(changed)}; delete it "
            "or choose another OUT"
        )
    return found
