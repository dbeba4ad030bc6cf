"""A procedural scene as a `vlgs.types.Scene`, ready for training and evaluation."""

import zlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.data.synthetic.capture import Shot, open_capture, open_world, regions
from vlgs.data.synthetic.labels import dense_labels, object_labels
from vlgs.data.synthetic.language import vocabulary
from vlgs.data.synthetic.masks import LEVELS, LabelNoise, LevelMasks, level_masks, view_masks
from vlgs.data.synthetic.photographs import TracedImage, photograph
from vlgs.data.synthetic.points import view_points
from vlgs.data.synthetic.scene_file import find_scene
from vlgs.data.synthetic.settings import MAX_VIEWS, SceneSettings
from vlgs.data.synthetic.world import World
from vlgs.types import Camera, ObjectLabels, Scene, View

_POINTS = 102  # purpose of draws


def load_scene(
    scene: str = "glassware",
    difficulty: str = "easy",
    width: int = 200,
    height: int = 150,
    train_views: int = 40,
    test_views: int = 8,
    seed: int = 0,
    points: int = 4000,
    level: int = 3,
    faults: LabelNoise = LabelNoise(),  # noqa: B008 (frozen)
    cache: str | None = None,
) -> Scene:
    """A procedural scene, ray-traced and held in memory.

    The same arguments give the same bits on one machine. See `vlgs.data.synthetic` for what the scenes are.

    Args:
        scene: ``glassware``, ``mirrors``, ``lookalikes`` or ``patchwork``; with ``_ring``, ``_sky`` or ``_wall`` after it, seen from there;
            ``wirework``, ``rows``, ``smallware``, ``sunroom`` or ``sunroom_even``. Or the path of a scene file of your own (conf/data/README.md).
        difficulty: ``easy``, or ``hard``: half as many things again, occlusion, about twice the faults.
        width: Pixels.
        height: Pixels; the field of view is fixed horizontally.
        train_views: Photographs with language supervision, evenly spaced along the walk.
        test_views: Held-out photographs, each halfway between two training ones (or as `vlgs.data.synthetic.outdoors` has it); fewer
            than `train_views`.
        seed: Of placement, hand shake, points and faults. Words have their vectors whatever the seed.
        points: Sparse points drawn; about a tenth is lost on glass and steel.
        level: Mask level of the supervision: 0 default, 1 subpart, 2 part, 3 whole.
        faults: How the supervision errs.
        cache: Folder that keeps the photographs, so that the next process need not trace them; None: nothing is kept.

    Raises:
        ValueError: If an argument is out of range, or the scene file is wrong.
    """
    if level not in range(4):
        raise ValueError(f"synthetic: level must be 0, 1, 2 or 3, got {level}")
    file = find_scene(scene)
    settings = SceneSettings(
        file, difficulty, width, height, train_views, test_views, seed, points, faults
    )
    folder = None if cache is None else Path(cache)
    capture = open_capture(settings, folder)
    world = capture.world
    readers, vectors, areas, offset = {}, [], [], 0
    for shot in capture.train:
        masks = _masks(settings, world, shot.photo, shot.number, level)
        count = masks.vectors.shape[0]
        # Those of hundreds of large photographs are gigabytes, and a view has few masks.
        small = np.int16 if count <= np.iinfo(np.int16).max else np.int32
        readers[shot.name] = partial(_rows, masks.index.astype(small), offset)
        vectors.append(masks.vectors)
        areas.append(np.bincount(masks.index[masks.index >= 0], minlength=count))
        offset += count
    cloud = [
        view_points(world, shot.camera, shot.photo, count, _draws(settings, shot))
        for shot, count in zip(capture.train, _shares(points, train_views), strict=True)
    ]
    return Scene(
        name=file.name,
        train=tuple(_view(world, shot, readers[shot.name]) for shot in capture.train),
        test=tuple(_view(world, shot, None) for shot in capture.test),
        split="synthetic",
        points=torch.cat([xyz for xyz, _ in cloud]),
        point_colors=torch.cat([rgb for _, rgb in cloud]),
        mask_vectors=torch.from_numpy(np.concatenate(vectors)),
        mask_areas=torch.from_numpy(np.concatenate(areas)).float(),
        classes=world.classes,
        class_kinds={thing.name: thing.kind for thing in world.things if thing.masked},
        vocabulary=vocabulary(world.classes),
        supervise=partial(_supervise, settings, level),
        fingerprint=settings.fingerprint(level),
    )


def language_levels(
    settings: SceneSettings, cache: Path | None = None
) -> Mapping[str, tuple[LevelMasks, LevelMasks, LevelMasks, LevelMasks]]:
    """Supervision of every training view at levels 0 to 3, by view name; what `write_scene` puts on disk."""
    capture = open_capture(settings, cache)
    return {
        shot.name: view_masks(
            *regions(capture.world, shot.photo),
            capture.world.classes,
            settings.faults.resolve(settings.difficulty),
            _key(settings, shot.number),
        )
        for shot in capture.train
    }


def _supervise(
    settings: SceneSettings, level: int, camera: Camera, number: int
) -> tuple[Int[Tensor, "h w"], Float[Tensor, "m e"]]:
    """Language maps of a rendered image, in place of SAM and CLIP: the exact regions at its camera, with errors like those of a photograph.

    Real extractors would also stumble over the faults of the render.
    """
    world = open_world(settings)
    photo = photograph(world, camera)
    masks = _masks(settings, world, photo, MAX_VIEWS + 1 + number, level)
    return torch.from_numpy(masks.index.astype(np.int32)), torch.from_numpy(masks.vectors)


def _masks(
    settings: SceneSettings, world: World, photo: TracedImage, number: int, level: int
) -> LevelMasks:
    faults = settings.faults.resolve(settings.difficulty)
    found = regions(world, photo, (level,) if level else LEVELS)
    return level_masks(*found, world.classes, faults, _key(settings, number), level)


def _key(settings: SceneSettings, number: int) -> tuple[int, ...]:
    """What the faults of a view are drawn by."""
    place = zlib.crc32(f"{settings.scene.key} {settings.difficulty}".encode())
    return settings.seed, place, number


def _view(world: World, shot: Shot, read_masks: Callable[[], Int[Tensor, "h w"]] | None) -> View:
    # Labels are made when they are asked for: those of hundreds of large photographs would be gigabytes.
    part = shot.photo.part
    asked = {world.classes.index(t.name): t.name for t in world.things if not t.background}
    smallest = max(4, round(5e-4 * part.size))

    def objects() -> ObjectLabels:
        return object_labels(world.class_of_part[part], world.thing_of_part[part], asked, smallest)

    return View(
        name=shot.name,
        camera=shot.camera,
        read_image=_reader(shot.photo.image),
        read_masks=read_masks,
        read_object_labels=objects,
        read_dense_labels=lambda: dense_labels(world.class_of_part[part]),
    )


def _reader(array: np.ndarray) -> Callable[[], Tensor]:
    """A reader that hands out copies, so that nobody can change what the next caller gets."""
    return lambda: torch.from_numpy(array.copy())


def _rows(index: Int[np.ndarray, "h w"], offset: int) -> Int[Tensor, "h w"]:
    """Rows of `Scene.mask_vectors` of the masks of a view, whose own begin at `offset`."""
    rows = torch.from_numpy(index.astype(np.int32))
    return torch.where(rows >= 0, rows + offset, -1)


def _shares(total: int, parts: int) -> list[int]:
    return [total * (i + 1) // parts - total * i // parts for i in range(parts)]


def _draws(settings: SceneSettings, shot: Shot) -> np.random.Generator:
    return np.random.default_rng([_POINTS, settings.seed, shot.number])
