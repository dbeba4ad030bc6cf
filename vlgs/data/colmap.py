"""A photographed scene: COLMAP's cameras and points, with labels and language maps where there are any.

    <root>/images/<name>.jpg                  or images_2, images_4, ...: scaled copies
    <root>/sparse/0/{cameras,images,points3D}.bin (or .txt; or right under sparse/; or transforms.json, poses_bounds.npy)
    <root>/labels/                            optional: see `vlgs.data.labels.open_labels`
    <root>/language_features/<stem>_{s,f}.npy optional: LangSplat's layout, and vocabulary.npz

Labels and language maps are matched to images by file stem and lie in the geometry of the image file: what the loader does
to a photograph (undistort, resize) it does to them.
"""

import hashlib
import logging
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch

from vlgs.data.cache import PixelCache
from vlgs.data.diagnostics import Fault, FaultList, SceneError, errors, require_sound, warning
from vlgs.data.images import transparency_warnings
from vlgs.data.labels import DenseFolder, ObjectFolder, open_labels
from vlgs.data.language import VOCABULARY_FILE, read_vocabulary
from vlgs.data.masks import (
    MaskTable,
    gather_masks,
    missing_faults,
    stray_faults,
    width_warnings,
)
from vlgs.data.posed_images import (
    ImageFolder,
    attach_labels,
    coverage_warnings,
    open_views,
    scale_faults,
)
from vlgs.data.source import ColmapSource, require_tree
from vlgs.data.sparse import (
    AT_HOME,
    Origin,
    SparseModel,
    model_faults,
    moved,
    origin_of,
    origin_warnings,
    read_sparse,
)
from vlgs.data.sparse.tracks import seen_by
from vlgs.data.views import ViewSource
from vlgs.types import Scene, Vocabulary

log = logging.getLogger(__name__)

_FEW_VIEWS = 6
"""Fewer training views than this give a warning."""

_MOST_WARNINGS = 8
"""Warnings that a run prints at most; `vlgs.check` lists all."""

_VERSION = "vlgs.data.colmap 1"
"""Part of the fingerprint: to be raised when the same files lead to other pixels."""


@dataclass(frozen=True)
class Survey:
    """The result of looking at a scene's files: what is wrong with them, and what can still be read."""

    faults: tuple[Fault, ...]
    model: SparseModel | None = None
    """None if the sparse files do not read."""
    views: tuple[ViewSource, ...] = ()
    """Every view whose photograph and camera are sound, in order of image name."""
    scene: Scene | None = None
    """None if a fault is an error."""


@dataclass(frozen=True)
class _Parts:
    """What a scene is put together from."""

    model: SparseModel
    origin: Origin
    views: tuple[ViewSource, ...]
    labels: DenseFolder | ObjectFolder | None
    masks: MaskTable | None
    vocabulary: Vocabulary | None


def load_scene(root: str, **options: Any) -> Scene:
    """Read a COLMAP scene; the `_target_` of ``conf/data/colmap.yaml``.

    Pixels stay on disk until a view's readers are called. Views are in order of image name.

    Args:
        root: Folder of the scene.
        options: Fields of `ColmapSource`.

    Raises:
        FileNotFoundError: If the scene, or a file or folder that was named, is not there.
        SceneError: For the first thing wrong with its files; ``python -m vlgs.check`` lists all.
        ValueError: If an option is out of range.
    """
    found = survey(ColmapSource(root=root, **options))
    require_sound(found.faults)
    _say_warnings(tuple(str(fault) for fault in found.faults))
    assert found.scene is not None
    return found.scene


@cache
def _say_warnings(warnings: tuple[str, ...]) -> None:
    """Log the warnings, once per process."""
    for line in warnings[:_MOST_WARNINGS]:
        log.warning("warning: %s", line)
    if len(warnings) > _MOST_WARNINGS:
        more = len(warnings) - _MOST_WARNINGS
        log.warning("warning: %d more, which python -m vlgs.check lists", more)


def survey(source: ColmapSource) -> Survey:
    """Look at all files of a scene and collect what is wrong; images and label maps are opened, not decoded.

    Raises:
        FileNotFoundError: If the scene, or a file or folder that was named, is not there.
    """
    folder, suffix = require_tree(source)
    try:
        model = read_sparse(folder, suffix)
    except SceneError as error:
        return Survey((error.fault,))
    faults = FaultList(model_faults(model))
    origin = AT_HOME if errors(faults) else origin_of(model)
    faults += origin_warnings(model, origin)
    model = moved(model, origin)
    images = ImageFolder(
        source.folder / source.images, source.resize, PixelCache(source.cache_bytes)
    )
    views = faults.take(open_views(model, images))
    faults += coverage_warnings(model, views, images)
    faults += transparency_warnings([view.photograph for view in views], images.path)
    faults += scale_faults(views)
    labels = faults.take(_open_labels(source, views))
    views = faults.take(attach_labels(views, labels, images))
    faults += source.rule.faults(*_names(views), str(source.folder))
    faults += _few_views(source, views)
    masks = faults.take(_open_masks(source, views))
    vocabulary = faults.take(_open_vocabulary(source, masks))
    if errors(faults):
        return Survey(tuple(faults), model, views)
    try:
        model = _few_points(source, model, views)
    except SceneError as error:
        return Survey((*faults, error.fault), model, views)
    scene = _assemble(source, _Parts(model, origin, views, labels, masks, vocabulary))
    return Survey(tuple(faults), model, views, scene)


def _few_points(
    source: ColmapSource, model: SparseModel, views: Sequence[ViewSource]
) -> SparseModel:
    """The points that training views saw, where only some train."""
    if source.train_views is None:
        return model
    train = set(source.rule.divide(*_names(views))[0])
    return seen_by(model, {i.name for i in model.images if Path(i.name).stem in train})


def open_training_views(source: ColmapSource, every_view: bool = False) -> tuple[ViewSource, ...]:
    """The views that language maps are read for, whether there are any maps or not: what `vlgs.features` works on.

    Args:
        source: The scene; its language maps and vocabulary are left aside.
        every_view: Whether test views are wanted too.

    Raises:
        FileNotFoundError: If the scene is not there.
        SceneError: For the first thing wrong with its cameras, photographs, labels or split.
    """
    folder, suffix = require_tree(source)
    model = read_sparse(folder, suffix)
    faults = FaultList(model_faults(model))
    images = ImageFolder(source.folder / source.images, source.resize, PixelCache(0))
    views = faults.take(open_views(model, images))
    labels = faults.take(_open_labels(source, views))
    views = faults.take(attach_labels(views, labels, images))
    faults += source.rule.faults(*_names(views), str(source.folder))
    require_sound(faults)
    train, _ = source.rule.divide(*_names(views))
    return tuple(view for view in views if every_view or view.name in set(train))


def _named_or_default(named: str | None, default: Path, key: str) -> Path | None:
    """The path that was named; else the default, or None if that is not there."""
    if named is None:
        return default if default.exists() else None
    if not Path(named).exists():
        raise FileNotFoundError(f"data: {key} must exist, got {named}")
    return Path(named)


def _open_labels(
    source: ColmapSource, views: Sequence[ViewSource]
) -> tuple[DenseFolder | ObjectFolder | None, tuple[Fault, ...]]:
    folder = _named_or_default(source.labels, source.folder / "labels", "labels")
    if folder is None:
        return None, ()
    labels, faults = open_labels(folder)
    if source.label_names == "position" and isinstance(labels, ObjectFolder):
        labels = labels.by_position(_names(views)[0])
    return labels, faults


def _few_views(source: ColmapSource, views: Sequence[ViewSource]) -> Iterator[Fault]:
    train, _ = source.rule.divide(*_names(views))
    if 0 < len(train) < _FEW_VIEWS:
        what = f"training views should be at least {_FEW_VIEWS}, got {len(train)} of {len(views)} with split={source.rule.name}"
        advice = (
            "so few leave most depths open, and other views will look wrong: take more photographs"
        )
        yield warning(source.folder, what, advice)


def _feature_folder(source: ColmapSource) -> Path | None:
    """The folder that was named; else the usual one, if there is a map in it: `vlgs.features` that was stopped early may have made none."""
    default = source.folder / "language_features"
    if source.features is None and not any(default.glob("*_[sf].npy")):
        return None
    return _named_or_default(source.features, default, "features")


def _open_masks(
    source: ColmapSource, views: Sequence[ViewSource]
) -> tuple[MaskTable | None, tuple[Fault, ...]]:
    """Language maps of the training views only: those of the test views must not be learned from."""
    folder = _feature_folder(source)
    if folder is None:
        return None, ()
    train, _ = source.rule.divide(*_names(views))
    training = [view for view in views if view.name in set(train)]
    table, found = gather_masks(training, folder, source.level)
    return table, (
        *found,
        *missing_faults(table, training, folder, source.allow_missing_masks),
        *stray_faults(folder, _names(views)[0]),
        *width_warnings(table, folder),
    )


def _open_vocabulary(
    source: ColmapSource, masks: MaskTable | None
) -> tuple[Vocabulary | None, tuple[Fault, ...]]:
    folder = _feature_folder(source) or source.folder / "language_features"
    path = _named_or_default(source.vocabulary, folder / VOCABULARY_FILE, "vocabulary")
    if path is None:
        return None, ()
    try:
        vocabulary = read_vocabulary(path)
    except SceneError as error:
        return None, (error.fault,)
    width = vocabulary.vectors.shape[1]
    if masks is not None and len(masks.vectors) and masks.vectors.shape[1] != width:
        what = f"embeddings must be {masks.vectors.shape[1]} wide as the mask vectors, got {width}"
        advice = "text and masks must come from one encoder"
        return None, (Fault(str(path), what, advice),)
    return vocabulary, ()


def _assemble(source: ColmapSource, parts: _Parts) -> Scene:
    """The scene of files that are sound."""
    train, test = source.rule.divide(*_names(parts.views))
    bound = parts.masks.sources if parts.masks is not None else {}
    used = {*train, *test}
    sources = [bound.get(view.name, view) for view in parts.views if view.name in used]
    # A part of them would be found again too seldom to be worth its memory, which it would leave in pieces.
    keep = sum(view.decoded_bytes for view in sources) <= source.cache_bytes
    readable = {view.name: replace(view, keep=keep).view() for view in sources}
    empty = torch.zeros(0, 512 if parts.vocabulary is None else parts.vocabulary.vectors.shape[1])
    classes, kinds = _classes(parts.labels, used)
    return Scene(
        name=source.folder.resolve().name,
        train=tuple(readable[name] for name in train),
        test=tuple(readable[name] for name in test),
        split=source.rule.name,
        points=torch.from_numpy(parts.model.points).float(),
        point_colors=torch.from_numpy(parts.model.point_colors),
        mask_vectors=empty if parts.masks is None else parts.masks.vectors,
        mask_areas=torch.zeros(0) if parts.masks is None else parts.masks.areas,
        classes=classes,
        class_kinds=kinds,
        vocabulary=parts.vocabulary,
        label_set=source.label_set,
        origin=parts.origin,
        fingerprint=_fingerprint(source, parts),
    )


def _classes(
    labels: DenseFolder | ObjectFolder | None, views: Set[str]
) -> tuple[tuple[str, ...], Mapping[str, str]]:
    if isinstance(labels, DenseFolder):
        return labels.classes, labels.class_kinds
    if labels is None:
        return (), {}
    if labels.classes is not None:
        return labels.classes, {}
    images = (image for stem, image in labels.images.items() if stem in views)
    return tuple(sorted({category for image in images for category in image.categories})), {}


def _fingerprint(source: ColmapSource, parts: _Parts) -> str:
    """Hash of all content that can move a number; folders do not count."""
    hasher = hashlib.blake2b(digest_size=16)
    options = (source.resize, source.level, source.rule, parts.model.cameras)
    hasher.update(repr((_VERSION, options)).encode())
    hasher.update(parts.model.points.tobytes() + parts.model.point_colors.tobytes())
    if parts.masks is not None:
        hasher.update(parts.masks.digest)
    if parts.vocabulary is not None:
        hasher.update(repr(parts.vocabulary.names).encode())
        hasher.update(parts.vocabulary.vectors.numpy().tobytes())
    if isinstance(parts.labels, DenseFolder):
        hasher.update(repr((parts.labels.classes, sorted(parts.labels.position.items()))).encode())
        kinds = sorted((c, k) for c, k in parts.labels.class_kinds.items() if k != "other")
        if kinds:
            hasher.update(repr(kinds).encode())
    elif parts.labels is not None and parts.labels.classes is not None:
        marked = {stem: sorted(image.categories) for stem, image in parts.labels.images.items()}
        hasher.update(repr((parts.labels.classes, sorted(marked.items()))).encode())
    if parts.origin != AT_HOME:
        hasher.update(repr(parts.origin).encode())
    if source.train_views is not None:
        hasher.update(repr(("train_views", source.train_views)).encode())
    if source.label_set:
        hasher.update(source.label_set.encode())
    for view in parts.views:
        files = [view.photograph.path, *_label_files(view)]
        hasher.update(repr((view.name, view.lens, len(files))).encode())
        hasher.update(view.camera.viewmat.numpy().tobytes())
        for file in files:
            with file.open("rb") as stream:
                hasher.update(hashlib.file_digest(stream, "blake2b").digest())
    return hasher.hexdigest()


def _label_files(view: ViewSource) -> tuple[Path, ...]:
    if isinstance(view.labels, ObjectFolder):
        return view.labels.images[view.name].files
    return () if view.labels is None else (view.labels.files[view.name],)


def _names(views: Sequence[ViewSource]) -> tuple[list[str], list[str]]:
    """Names of all views and of the labelled ones."""
    return [v.name for v in views], [v.name for v in views if v.labels is not None]
