"""Writes a trained scene to one file that others can open: a page that works offline, or Gaussians for other programs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vlgs.data.sparse import AT_HOME, subtracted
from vlgs.export.content import Content, answer, drawn, most_important, selected
from vlgs.export.page import write_page
from vlgs.files import write_atomically
from vlgs.formats import FORMATS, Imported, write_gaussians
from vlgs.opened import OpenedRun
from vlgs.values import require_range

__all__ = ["Wanted", "export", "kind_of"]

_KINDS = {
    ".html": "page",
    ".ply": "3dgs-ply",
    ".compressed.ply": "compressed-ply",
    ".splat": "splat",
}
"""Suffix -> what is written."""


@dataclass(frozen=True)
class Wanted:
    """What should be in the file. None: as it is without the option.

    Raises:
        ValueError: If a number is out of range.
    """

    words: Sequence[str] | None = None
    """That a page can be asked; None: the classes of the scene, if its language can be asked."""
    select: str | None = None
    """Write only the Gaussians that answer this word; not for a page."""
    level: int | None = None
    """Mask level, by its number, that answers."""
    most: int | None = None
    """Gaussians to keep."""
    harmonics: int | None = None
    """Highest degree of the spherical harmonics to keep."""

    def __post_init__(self) -> None:
        if self.most is not None and self.most < 1:
            raise ValueError(f"export: most must be at least 1, got {self.most}")
        require_range("export", 0, 3, harmonics=self.harmonics)


def kind_of(target: Path) -> str:
    """What a file of this name holds: ``page``, or a name of `vlgs.formats.FORMATS`.

    Raises:
        ValueError: If the suffix is none that is written.
    """
    name = target.name.lower()
    for suffix in sorted(_KINDS, key=len, reverse=True):
        if name.endswith(suffix):
            return _KINDS[suffix]
    raise ValueError(f"export: OUT must end in {', '.join(_KINDS)}, got {target.name}")


def export(opened: OpenedRun, target: Path, wanted: Wanted) -> list[str]:
    """Write the file, and say in a few lines what is in it.

    Raises:
        ValueError: If the suffix is unknown, the run has no Gaussians, or a word cannot be encoded.
        OSError: If the file cannot be written.
    """
    kind = kind_of(target)
    if kind == "page" and wanted.select is not None:
        raise ValueError("export: --select must go with a file of Gaussians, got a page: --words")
    if kind != "page" and wanted.words is not None:
        raise ValueError(f"export: --words must go with .html, got {target.name}: --select WORD")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"export: OUT must be in a folder that exists, got {target}")
    level = None if wanted.level is None else opened.place(wanted.level)
    if wanted.select is not None:
        content = selected(opened, wanted.select, level)
    else:
        content = answer(opened, _words(opened, kind, wanted), level)
    if wanted.harmonics is not None:
        content = content.with_harmonics(wanted.harmonics)
    if kind == "page":
        content = drawn(content)
    if content.count == 0:
        raise ValueError(f"{opened.path}: must have Gaussians that are seen, got none")
    if wanted.most is not None:
        content = most_important(content, opened, wanted.most)
    lost = []
    if kind == "page":
        write_atomically(target, write_page(opened, content))
    else:
        imported = Imported(content.cloud.params, opened.field.has_language, False, {})
        lost = write_gaussians(target, imported, kind)
    return [*_said(opened, target, kind, content), *(f"not kept: {what}" for what in lost)]


def _said(opened: OpenedRun, target: Path, kind: str, content: Content) -> list[str]:
    size = target.stat().st_size
    what = "a page" if kind == "page" else FORMATS[kind][1]
    lines = [f"{target}: {content.count:,} Gaussians as {what}, {size / 1e6:.2f} MB"]
    if kind == "page":
        words = ", ".join(word.name for word in content.words)
        lines.append(f"words: {words}" if words else "no words")
    elif opened.notes.origin != AT_HOME:
        lines.append(subtracted(opened.notes.origin))
    return [*lines, *content.notes]


def _words(opened: OpenedRun, kind: str, wanted: Wanted) -> Sequence[str]:
    if kind != "page":
        return ()
    if wanted.words is not None:
        return tuple(dict.fromkeys(wanted.words))
    return opened.notes.classes if opened.field.has_language else ()
