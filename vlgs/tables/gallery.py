"""What gallery.json says of the pictures of a benchmark: written by `vlgs.gallery`, shown by the pages, believed by neither. Imports no torch."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_type_hints

from vlgs.files import write_changed
from vlgs.tables.registry import is_label
from vlgs.values import require_range, require_types

FILE = "gallery.json"
FOLDER = "gallery"
"""Of a benchmark."""
FORM = "vlgs-gallery-1"

_REMEDY = "python -m vlgs.gallery draws it anew where the runs lie, and without the file there is no gallery"
_MOST_BYTES = 16 << 20
"""Of the file; a view of ten rows takes three thousand."""
_LARGEST = 1 << 16
"""Pixels on a side."""


@dataclass(frozen=True)
class Shown:
    """What one row of a table shows of a view. Files are named below the gallery's folder."""

    label: str
    run: str
    """Id of the run."""
    render: str
    psnr: float | None
    """Of this view, as the run was scored; None where it was not."""
    relevancy: str | None
    """Where it answers the word; None of a row without language."""
    iou: float | None
    """Of the word in this view, in [0, 1], as the run was scored."""

    def __post_init__(self) -> None:
        require_range(FILE, 0, 1, iou=self.iou)

    @property
    def files(self) -> list[str]:
        """Of this row."""
        return [self.render, *([self.relevancy] if self.relevancy else [])]


@dataclass(frozen=True)
class GalleryView:
    """A held-out view, the photograph beside what every row of a table shows."""

    scene: str
    view: str
    place: Literal["lowest", "highest"]
    """Of all held-out views by mean PSNR over the rows."""
    tab: str
    seed: int
    results_version: int
    protocol: str
    """Under which `Shown.iou` was scored."""
    width: int
    height: int
    photograph: str
    word: str | None
    """What is asked for; None where nothing fitting is labelled."""
    outlined: str | None
    """The photograph with the outline of what the word means."""
    rows: Sequence[Shown]

    def __post_init__(self) -> None:
        require_range(FILE, 1, _LARGEST, width=self.width, height=self.height)
        if not is_label(self.tab):
            raise ValueError(f"{FILE}: tab must be the label of a table, got {self.tab!r:.80}")

    @property
    def files(self) -> list[str]:
        """All pictures."""
        own = [self.photograph, *([self.outlined] if self.outlined else [])]
        return [*own, *(name for row in self.rows for name in row.files)]


def read_gallery(folder: Path) -> list[GalleryView]:
    """The gallery of a benchmark's folder; empty without one.

    Raises:
        ValueError: If gallery.json is not as `write_gallery` leaves it, or names what is no picture inside of the gallery's folder; both
            are named.
        OSError: If it cannot be read.
    """
    path = folder / FOLDER / FILE
    if not path.exists():
        return []
    try:
        views = [_view(one) for one in _content(path)]
        for view in views:
            for name in view.files:
                _require_inside(path.parent, name)
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{path}: must be as vlgs.gallery writes it, got: {error!s:.200}; {_REMEDY}"
        ) from error
    return views


def write_gallery(folder: Path, views: Sequence[GalleryView]) -> None:
    """Write gallery.json of a benchmark's folder; the pictures are there already."""
    text = json.dumps({"form": FORM, "views": list(map(asdict, views))}, indent=1)
    write_changed(folder / FOLDER / FILE, f"{text}\n".encode())


def _content(path: Path) -> list[Any]:
    if not path.is_file():  # a pipe would be waited for without end
        raise ValueError("a folder or a device")
    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(f"more than {_MOST_BYTES} bytes")
    content = json.loads(path.read_bytes().decode())
    if not isinstance(content, dict) or content.get("form") != FORM:
        raise ValueError(f"no object of form {FORM}")
    if not isinstance(content.get("views"), list):
        raise ValueError("no list of views")
    return content["views"]


def _view(content: Any) -> GalleryView:
    known = _checked(GalleryView, content)
    return GalleryView(
        **{**known, "rows": tuple(Shown(**_checked(Shown, one)) for one in known["rows"])}
    )


def _checked(kind: type[Any], content: Any) -> dict[str, Any]:
    """The arguments of a dataclass, each of its type but for rows, whose entries are looked at by themselves."""
    wanted = {field.name for field in fields(kind)}
    if not isinstance(content, dict) or set(content) != wanted:
        raise ValueError(f"an entry without just the keys {', '.join(sorted(wanted))}")
    require_types("entry", {**get_type_hints(kind), "rows": Sequence[Any]}, content)
    return content


def _require_inside(folder: Path, name: str) -> None:
    """Do nothing if a name is that of a picture below a folder, whatever links there are."""
    if not name.endswith(".jpg") or not name.isprintable():
        raise ValueError(f"{name!r:.80}, which is no name of a .jpg")
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"{name!r:.80}, which lies outside of the folder")
    if not path.is_file():
        raise ValueError(f"{name!r:.80}, which is not there")
