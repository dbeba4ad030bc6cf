"""Write a scene to disk in the formats that the field reads, and that `vlgs.data.colmap` reads back.

<root>/images/<stem>.png
<root>/sparse/0/{cameras,images,points3D}.bin          COLMAP's binary model
<root>/labels/<stem>.png and classes.json              class ids per pixel, exact
<root>/label/<stem>.json                               polygons as in LERF-OVS; they cannot have holes
<root>/language_features/<stem>_s.npy, <stem>_f.npy    as in LangSplat, and vocabulary.npz
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from vlgs.data.export.outline import outlines
from vlgs.data.export.sparse import write_sparse
from vlgs.data.language import VOCABULARY_FILE, write_mask_files, write_vocabulary
from vlgs.files import new_folder
from vlgs.types import Scene, View, Vocabulary


@runtime_checkable
class MaskLevel(Protocol):
    """Masks of one view at one level; `vlgs.data.synthetic.LevelMasks` is one."""

    @property
    def index(self) -> Int[np.ndarray, "h w"]:
        """Row of `vectors` per pixel, -1 where no mask lies."""
        ...

    @property
    def vectors(self) -> Float[np.ndarray, "m e"]:
        """Unit length."""
        ...


def write_scene(
    scene: Scene, root: str | Path, language: Mapping[str, Sequence[MaskLevel]] | None = None
) -> None:
    """Write a scene to a new folder: all of it, or nothing.

    Args:
        scene: What to write. Its training and test views become one set of images; whoever reads it says which are held
            out. Labels are written for the views that have them.
        root: A folder that does not exist or is empty.
        language: View name -> masks at levels 0 to 3, as from `vlgs.data.synthetic.language_levels`. A scene alone carries
            one level; without this no language maps are written.

    Raises:
        ValueError: If the folder is not empty, a view to which `language` refers does not exist or has not four levels.
    """
    root = Path(root)
    views = sorted({view.name: view for view in (*scene.train, *scene.test)}.values(), key=_name)
    language = language or {}
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise ValueError(f"write_scene: root must be a new or empty folder, got {root}")
    if unknown := sorted(set(language) - {view.name for view in views}):
        raise ValueError(f"write_scene: language must name views of the scene, got {unknown[0]}")
    if short := [name for name, levels in language.items() if len(levels) != 4]:
        raise ValueError(f"write_scene: language must have 4 levels, got {len(language[short[0]])}")
    with new_folder(root) as folder:
        (folder / "images").mkdir()
        for view in views:
            Image.fromarray(view.read_image().numpy()).save(folder / "images" / f"{view.name}.png")
        write_sparse(folder / "sparse" / "0", scene, views)
        _write_dense(folder / "labels", scene, views)
        _write_objects(folder / "label", views)
        if language:
            _write_language(folder / "language_features", language, scene.vocabulary)


def _name(view: View) -> str:
    return view.name


def _write_dense(folder: Path, scene: Scene, views: Sequence[View]) -> None:
    labelled = [view for view in views if view.read_dense_labels is not None]
    if not labelled:
        return
    folder.mkdir()
    classes = {}
    for number, name in enumerate(scene.classes):
        kind = {"kind": scene.class_kinds[name]} if name in scene.class_kinds else {}
        classes[str(number)] = {"name": name, **kind}
    (folder / "classes.json").write_text(json.dumps({"classes": classes}, indent=1))
    for view in labelled:
        assert view.read_dense_labels is not None
        ids = view.read_dense_labels().ids.numpy()
        Image.fromarray(ids).save(folder / f"{view.name}.png")


def _write_objects(folder: Path, views: Sequence[View]) -> None:
    for view in views:
        if view.read_object_labels is None:
            continue
        folder.mkdir(exist_ok=True)
        objects = []
        for category, mask in sorted(view.read_object_labels().masks.items()):
            for outline in outlines(mask.numpy()):
                low, high = outline.min(axis=0).tolist(), outline.max(axis=0).tolist()
                objects.append(
                    {
                        "category": category,
                        "segmentation": outline.tolist(),
                        "bbox": [*low, *high],
                    }
                )
        info = {
            "name": f"{view.name}.png",
            "width": view.camera.width,
            "height": view.camera.height,
        }
        content = json.dumps({"info": info, "objects": objects})
        (folder / f"{view.name}.json").write_text(content)


def _write_language(
    folder: Path, language: Mapping[str, Sequence[MaskLevel]], vocabulary: Vocabulary | None
) -> None:
    folder.mkdir()
    for name, levels in language.items():
        starts = np.cumsum([0, *(level.vectors.shape[0] for level in levels[:-1])])
        maps = [
            np.where(level.index >= 0, level.index + start, -1)
            for level, start in zip(levels, starts, strict=True)
        ]
        vectors = np.concatenate([level.vectors for level in levels])
        write_mask_files(folder, name, np.stack(maps), vectors)
    if vocabulary is not None:
        write_vocabulary(folder / VOCABULARY_FILE, vocabulary)
