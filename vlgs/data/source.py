"""Where a photographed scene lies, how it is read, and which folders it must have."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vlgs.data.diagnostics import listing
from vlgs.data.sparse import find_sparse
from vlgs.data.split import Split
from vlgs.values import require_fields


@dataclass(frozen=True, kw_only=True)
class ColmapSource:
    """What to read, and how. The keys of ``conf/data/colmap.yaml``."""

    root: str
    """Folder of the scene; with `scene`, of a release with several."""
    scene: str | None = None
    """Folder below `root`."""
    images: str = "images"
    """Image folder below it."""
    resize: float = 1.0
    """Size of the output as a fraction of the image file's, in (0, 1]; pixels are averaged over their area."""
    split: str = "llff"
    """See `vlgs.data.split.Split`."""
    test: Sequence[str] = ()
    """Stems of the test views, with split=list."""
    every: int = 8
    """One view of so many is held out, with split=llff."""
    train_views: int | None = None
    """Train on so many of the views that are not held out, as if the rest had not been taken: sparse points that fewer than two of them saw are left
    out, where COLMAP says who saw them."""
    labels: str | None = None
    """Label folder; by default ``<root>/labels`` if there is one."""
    label_names: str = "stem"
    """How labels name their images: ``stem``, or ``position``: see `vlgs.data.labels.ObjectFolder.by_position`."""
    label_set: str = ""
    """Goes into the name of the protocol; see `vlgs.types.Scene.label_set`."""
    features: str | None = None
    """Folder of language maps; by default ``<root>/language_features`` if there is one."""
    vocabulary: str | None = None
    """npz or JSON of text vectors; by default ``<features>/vocabulary.npz`` if there is one."""
    level: int = 3
    """Mask level: 0 default, 1 subpart, 2 part, 3 whole."""
    allow_missing_masks: bool = False
    """Whether a training view may lack language maps where others have them."""
    cache_bytes: int = 1 << 26
    """Memory for decoded pixels: those of all views are kept, or none, and always the tables of undistortion."""
    release: Mapping[str, Any] = field(default_factory=dict)
    """Settings of a data set's release, from which its paths are made; `name` is the name of the data set in errors."""

    def __post_init__(self) -> None:
        require_fields("data", self)
        if not 0 < self.resize <= 1:
            raise ValueError(f"data: resize must be in (0, 1], got {self.resize}")
        if self.level not in range(4):
            raise ValueError(f"data: level must be 0, 1, 2 or 3, got {self.level}")
        if self.cache_bytes < 0:
            raise ValueError(f"data: cache_bytes must not be negative, got {self.cache_bytes}")
        if self.label_names not in ("stem", "position"):
            expected = "label_names must be stem or position"
            raise ValueError(f"data: {expected}, got {self.label_names!r}")
        _ = self.rule

    @property
    def folder(self) -> Path:
        """Of the scene."""
        return Path(self.root) / (self.scene or "")

    @property
    def rule(self) -> Split:
        """How the views are divided."""
        return Split(self.split, tuple(map(str, self.test)), self.every, self.train_views)


def require_tree(source: ColmapSource) -> tuple[Path, str]:
    """Folder and suffix of the sparse files.

    Raises:
        FileNotFoundError: If a folder that must be there is not; the message shows the tree.
    """
    found = find_sparse(source.folder)
    if found is None or not all(there for _, there, _ in _tree(source) if there is not None):
        raise FileNotFoundError(_missing(source))
    return found


def _tree(source: ColmapSource) -> list[tuple[Path, bool | None, str]]:
    """Every folder of a scene, whether it is there (None: it need not be) and what it holds."""
    folder = source.folder
    sparse = (
        "cameras.bin images.bin points3D.bin (or .txt; or right under sparse/; or else transforms.json or "
        "poses_bounds.npy in the scene's folder)"
    )
    tree: list[tuple[Path, bool | None, str]] = [
        (Path(source.root), Path(source.root).is_dir(), ""),
        (folder, folder.is_dir(), ""),
        (folder / "sparse" / "0", find_sparse(folder) is not None, sparse),
        (folder / source.images, (folder / source.images).is_dir(), "<name>.jpg ..."),
        (folder / "language_features", None, "<stem>_s.npy <stem>_f.npy, optional"),
    ]
    if source.scene and source.labels:
        tree.append((Path(source.labels), Path(source.labels).is_dir(), "labels"))
    return list(dict.fromkeys(tree))


def _missing(source: ColmapSource) -> str:
    """The message that a scene is not there: what it lacks, and its tree with a tick or a cross for each folder."""
    root, tree = Path(source.root), _tree(source)
    lacks = next((path for path, there, _ in tree if there is False), None)
    absent = f"no {lacks}"
    if not source.folder.is_dir():
        absent = f"no such folder as {source.folder}"
    elif lacks == source.folder / "sparse" / "0":
        absent = f"no sparse model in {source.folder}"
    if source.scene and root.is_dir() and not source.folder.is_dir():
        there = listing(sorted(path.name for path in root.iterdir() if path.is_dir()))
        absent += f" (folders beside it: {there})"
    what = source.release.get("name", "a COLMAP scene")
    lines = [
        f"  {'✓' if (path.is_dir() if there is None else there) else '✗'} {path}/  {note}".rstrip()
        for path, there, note in tree
    ]
    return "\n".join([f"data: root must hold {what}, got {absent}; looked for", *lines])
