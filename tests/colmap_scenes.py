"""Small COLMAP scenes for the tests of `vlgs.data.colmap`, written by pycolmap."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vlgs.data.lens import import_pycolmap
from vlgs.types import Scene

pycolmap = import_pycolmap()

WIDTH, HEIGHT = 24, 18
PINHOLE = ("PINHOLE", (20.0, 21.0, 12.5, 8.5))
RADIAL = ("RADIAL", (20.0, 12.5, 8.5, -0.1, 0.02))


def picture(seed: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Random pixels that survive PNG."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def write_model(
    folder: Path,
    names: list[str],
    camera: tuple[str, tuple[float, ...]] = PINHOLE,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    points: int = 6,
    text: bool = False,
) -> Any:
    """A `pycolmap.Reconstruction` whose points are all seen by all images, at poses that differ."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model=camera[0], width=size[0], height=size[1], params=camera[1], camera_id=1
        )
    )
    rng = np.random.default_rng(0)
    for i, name in enumerate(names, start=1):
        angle = 0.1 * i
        quat_xyzw = np.array([0, np.sin(angle / 2), 0, np.cos(angle / 2)])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(quat_xyzw), np.array([0.1 * i, 0.2, 3.0]))
        image = pycolmap.Image(
            name=name, keypoints=rng.uniform(0, 18, (points, 2)), camera_id=1, image_id=i
        )
        model.add_image_with_trivial_frame(image, pose)
    for p in range(points):
        track = pycolmap.Track()
        for i in range(1, len(names) + 1):
            track.add_element(i, p)
        model.add_point3D(rng.normal(size=3), track, rng.integers(0, 256, 3).astype(np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    model.write_text(str(folder)) if text else model.write(str(folder))
    return model


def write_scene(root: Path, n: int = 9, **model) -> list[str]:
    """A whole scene; returns the stems, in order."""
    names = [f"frame_{i:05d}.png" for i in range(n)]
    write_model(root / "sparse" / "0", names, **model)
    (root / "images").mkdir()
    size = model.get("size", (WIDTH, HEIGHT))
    for i, name in enumerate(names):
        Image.fromarray(picture(i, *size)).save(root / "images" / name)
    return [Path(name).stem for name in names]


UTM = (500_123.25, 5_412_345.5, 312.125)


def surveyed(root: Path, shift: tuple[float, float, float] = UTM) -> Path:
    """The same scene in the coordinates of a map; pycolmap moves it."""
    write_scene(root)
    model = pycolmap.Reconstruction(str(root / "sparse" / "0"))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(shift)))
    model.write(str(root / "sparse" / "0"))
    return root


def unit_rows(n: int, seed: int, width: int = 8) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(n, width))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def add_masks(root: Path, stems: list[str], width: int = 8) -> dict[str, tuple]:
    """Two masks a view at level 3, after one at level 0 that covers all and one that no pixel has."""
    (root / "language_features").mkdir(exist_ok=True)
    written = {}
    for i, stem in enumerate(stems):
        ids = np.full((4, HEIGHT, WIDTH), -1, np.float32)
        ids[0] = 0
        ids[3, :, 4:] = 2
        ids[3, 5:9, 10:15] = 3
        vectors = unit_rows(4, i, width)
        np.save(root / "language_features" / f"{stem}_s.npy", ids)
        np.save(root / "language_features" / f"{stem}_f.npy", vectors)
        written[stem] = (ids[3], vectors)
    return written


def add_dense(root: Path, stems: list[str]) -> dict[str, np.ndarray]:
    (root / "labels").mkdir(exist_ok=True)
    classes = {"3": {"name": "glass", "kind": "translucent_reflective"}, "5": {"name": "wall"}}
    (root / "labels" / "classes.json").write_text(json.dumps({"classes": classes}))
    written = {}
    for i, stem in enumerate(stems):
        ids = np.random.default_rng(i).choice(np.array([3, 5, 255], np.uint8), (HEIGHT, WIDTH))
        Image.fromarray(ids).save(root / "labels" / f"{stem}.png")
        written[stem] = ids
    return written


def add_objects(folder: Path, stem: str, scale: int = 1) -> None:
    folder.mkdir(exist_ok=True)
    square = [
        [2 * scale, 4 * scale],
        [8 * scale, 4 * scale],
        [8 * scale, 6 * scale],
        [2 * scale, 6 * scale],
    ]
    box = [2 * scale, 4 * scale, 8 * scale, 6 * scale]
    info = {"name": f"{stem}.jpg", "width": WIDTH * scale, "height": HEIGHT * scale}
    objects = [{"category": "cup", "segmentation": square, "bbox": box}]
    (folder / f"{stem}.json").write_text(json.dumps({"info": info, "objects": objects}))


def stems_of(scene: Scene) -> tuple[list[str], list[str]]:
    return [v.name for v in scene.train], [v.name for v in scene.test]
