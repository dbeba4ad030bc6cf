"""Dense labels: ``<stem>.png`` with a class id per pixel, and ``classes.json``.

    {"classes": {"0": {"name": "sky", "kind": "other"}, "11": {"name": "unlabelled", "ignore": true}}}

Pixels of a class that is ignored, and pixels with id 255, take no part in any score. `kind` is optional.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from vlgs.data.diagnostics import Fault, SceneError, listing
from vlgs.data.labels.pictures import find_pngs
from vlgs.data.untrusted.pictures import picture
from vlgs.data.untrusted.text import read_json
from vlgs.types import IGNORE_ID

KINDS = ("translucent_reflective", "other")


@dataclass(frozen=True)
class DenseFolder:
    """A folder of dense labels, opened."""

    files: Mapping[str, Path]
    """Stem -> PNG."""
    sizes: Mapping[str, tuple[int, int]]
    """Stem -> width and height."""
    classes: tuple[str, ...]
    """Names of the classes that count, by rising id in the files."""
    class_kinds: Mapping[str, str]
    position: Mapping[int, int]
    """Id in the files -> index into `classes`, or `IGNORE_ID`."""

    def read_ids(self, stem: str) -> UInt8[np.ndarray, "h w"]:
        """Positions in `classes`, or `IGNORE_ID`, at the size of the file.

        Raises:
            SceneError: If the file does not decode or has an id that ``classes.json`` lacks.
        """
        path = self.files[stem]
        with picture(path, decode=True) as image:
            ids = np.asarray(image)
        if ids.dtype != np.uint8 or ids.shape != self.sizes[stem][::-1]:
            what = (
                f"must still be 8-bit ids of {self.sizes[stem]}, got {ids.dtype} {ids.shape[::-1]}"
            )
            raise SceneError(Fault(str(path), what))
        unknown = sorted(set(np.unique(ids).tolist()) - set(self.position))
        if unknown:
            expected = f"ids of classes.json ({listing(map(str, sorted(self.position)), 20)})"
            raise SceneError(
                Fault(str(path), f"pixels must be {expected}, got {listing(map(str, unknown))}")
            )
        table = np.full(256, IGNORE_ID, np.uint8)
        table[list(self.position)] = list(self.position.values())
        return table[ids]


def open_dense(folder: Path) -> tuple[DenseFolder | None, tuple[Fault, ...]]:
    """Read ``classes.json`` and the headers of the PNGs; see `vlgs.data.labels.open_labels`."""
    path = folder / "classes.json"
    expected = '{"classes": {"<id>": {"name": ...}}}'
    try:
        listed = read_json(path, expected)["classes"]
        faults = list(_class_faults(str(path), listed))
    except SceneError as error:
        return None, (error.fault,)
    except (KeyError, TypeError, AttributeError) as error:
        what = f"content must be {expected}, got {type(error).__name__}: {error}"
        return None, (Fault(str(path), what[:400]),)
    if faults:
        return None, tuple(faults)
    by_id = sorted((int(key), entry) for key, entry in listed.items())
    counted = [(i, entry) for i, entry in by_id if not entry.get("ignore", False)]
    position = {i: IGNORE_ID for i, _ in by_id} | {IGNORE_ID: IGNORE_ID}
    position |= {i: n for n, (i, _) in enumerate(counted)}
    files = {file.stem: file for file in find_pngs(folder)}
    if not files:
        what = "label images must be at least 1, got 0"
        faults.append(Fault(str(folder), what, "name them <stem>.png"))
    sizes = {}
    for stem, file in files.items():
        try:
            sizes[stem] = _png_size(file)
        except SceneError as error:
            faults.append(error.fault)
    return DenseFolder(
        files={stem: files[stem] for stem in sizes},
        sizes=sizes,
        classes=tuple(entry["name"] for _, entry in counted),
        class_kinds={entry["name"]: entry["kind"] for _, entry in counted if "kind" in entry},
        position=position,
    ), tuple(faults)


def _class_faults(file: str, listed: Mapping[str, dict]) -> Iterator[Fault]:
    names = []
    for key, entry in listed.items():
        if not re.fullmatch("0|[1-9][0-9]{0,8}", key) or int(key) >= IGNORE_ID:
            yield Fault(file, f"class id must be 0 to {IGNORE_ID - 1}, got {key[:40]!r}")
        name, kind, ignored = (
            entry.get("name"),
            entry.get("kind", "other"),
            entry.get("ignore", False),
        )
        if not isinstance(name, str) or not name.strip():
            yield Fault(file, f"class {key}: name must be a word, got {name!r}")
        if kind not in KINDS:
            yield Fault(file, f"class {key}: kind must be one of {listing(KINDS)}, got {kind!r}")
        if not isinstance(ignored, bool):
            yield Fault(file, f"class {key}: ignore must be true or false, got {ignored!r}")
        names += [] if ignored else [name]
    if not names:
        yield Fault(file, "classes that count must be at least 1, got 0")
    if len(set(names)) < len(names):
        yield Fault(file, f"class names must be unique, got {names}")


def _png_size(path: Path) -> tuple[int, int]:
    with picture(path) as image:
        mode, size = image.mode, image.size
    if mode not in ("L", "P"):
        advice = "write class ids, not colours"
        raise SceneError(
            Fault(str(path), f"pixels must be one 8-bit id each, got mode {mode}", advice)
        )
    return size
