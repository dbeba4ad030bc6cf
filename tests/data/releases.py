"""Miniature releases: the procedural scene in the folder layout of each data set, file names included."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vlgs.data.export import write_scene
from vlgs.data.synthetic import SceneSettings, language_levels, load_scene
from vlgs.types import ObjectLabels, Scene, View

SIZE: dict[str, Any] = {"width": 64, "height": 48, "train_views": 4, "test_views": 2}


def truth() -> Scene:
    """What every release holds."""
    return load_scene(**SIZE)


def as_taken(scene: Scene) -> Scene:
    """The same views under the names that a camera gives, which is how Mip-NeRF 360 has them; the order stays."""
    names = sorted(view.name for view in (*scene.train, *scene.test))
    new = {name: f"DSC{7950 + 3 * i:05d}" for i, name in enumerate(names)}
    train = tuple(replace(view, name=new[view.name]) for view in scene.train)
    test = tuple(replace(view, name=new[view.name]) for view in scene.test)
    return replace(scene, train=train, test=test)


def class_masks(view: View, scene: Scene) -> dict[str, np.ndarray]:
    """Class -> mask, of the classes that the view shows."""
    assert view.read_dense_labels is not None
    ids = view.read_dense_labels().ids.numpy()
    return {name: ids == i for i, name in enumerate(scene.classes) if (ids == i).any()}


def objects(view: View) -> ObjectLabels:
    assert view.read_object_labels is not None
    return view.read_object_labels()


def _write_colmap(scene: Scene, folder: Path) -> None:
    levels = language_levels(SceneSettings(**SIZE))
    language = dict(zip((view.name for view in scene.train), levels.values(), strict=True))
    some = next(iter(language.values()))
    # A release has language maps of every image; those of the held-out ones are never compared.
    write_scene(scene, folder, language | {view.name: some for view in scene.test})
    shutil.rmtree(folder / "labels")


def write_lerf_ovs(scene: Scene, root: Path, name: str = "ramen") -> None:
    _write_colmap(scene, root / name)
    (root / "label").mkdir()
    (root / name / "label").rename(root / "label" / name)
    for view in scene.train:
        (root / "label" / name / f"{view.name}.json").unlink(missing_ok=True)
    for view in scene.test:  # the release has the annotated photographs beside their labels
        image = Image.fromarray(view.read_image().numpy())
        image.save(root / "label" / name / f"{view.name}.jpg")


def write_ovs3d(scene: Scene, root: Path, name: str = "bed") -> None:
    _write_colmap(scene, root / name)
    shutil.rmtree(root / name / "label")
    folder = root / name / "segmentations"
    folder.mkdir()
    (folder / "classes.txt").write_text("\n".join(reversed(scene.classes)) + "\n\n")
    for view in scene.test:
        (folder / view.name).mkdir()
        for category, mask in class_masks(view, scene).items():
            Image.fromarray(mask.astype(np.uint8) * 255).save(
                folder / view.name / f"{category}.png"
            )


def write_mipnerf360(scene: Scene, root: Path, name: str = "garden") -> None:
    _write_colmap(as_taken(scene), root / name)
    shutil.rmtree(root / name / "label")
    images = root / name / "images"
    images.rename(root / name / "images_4")
    images.mkdir()


def write_goi(scene: Scene, root: Path, name: str = "garden") -> None:
    for view in as_taken(scene).test:
        for category, mask in class_masks(view, scene).items():
            folder = root / name / category / "masks"
            folder.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask.astype(np.uint8) * 255).save(folder / f"{view.name}.png")


def write_gags(scene: Scene, root: Path, name: str = "garden") -> None:
    whole = root / "whole"
    write_scene(scene, whole)
    (root / name).mkdir()
    names = sorted(view.name for view in (*scene.train, *scene.test))
    for view in scene.test:
        target = root / name / f"frame_{names.index(view.name) + 1:05d}.json"
        target.write_text((whole / "label" / f"{view.name}.json").read_text())
    shutil.rmtree(whole)
