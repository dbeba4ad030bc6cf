"""All photographs of a scene, and the exact masks in them. They are rendered once."""

import functools
import logging
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np
from jaxtyping import Int

from vlgs.data.synthetic.cameras import camera_at, held, moments, stop_at
from vlgs.data.synthetic.layouts import build
from vlgs.data.synthetic.masks import LEVELS, NO_NOISE, Region
from vlgs.data.synthetic.photographs import TracedImage, exposures, photograph
from vlgs.data.synthetic.scene_file import SceneFile
from vlgs.data.synthetic.settings import SceneSettings
from vlgs.data.synthetic.world import World
from vlgs.data.untrusted.arrays import Archive
from vlgs.files import write_atomically
from vlgs.types import Camera

log = logging.getLogger(__name__)

_LAYOUT, _WALK, _EXPOSURE = 100, 101, 103  # purposes of draws; `masks` and `scene` have others
_PATCHES = 1 << 16
_FIELDS = tuple(field.name for field in fields(TracedImage))


@dataclass(frozen=True)
class Shot:
    """One photograph with its place in the walk."""

    name: str
    number: int
    """Among the training views, or among the held-out ones."""
    camera: Camera
    photo: TracedImage


@dataclass(frozen=True)
class Capture:
    """What does not depend on faults, points and level."""

    world: World
    train: tuple[Shot, ...]
    test: tuple[Shot, ...]


def open_world(settings: SceneSettings) -> World:
    """What is photographed; built once, as every rendered image that is given masks asks for it again."""
    return _built(settings.scene, settings.difficulty, settings.seed)


@functools.lru_cache(maxsize=2)
def _built(scene: SceneFile, difficulty: str, seed: int) -> World:
    things = build(scene, difficulty, np.random.default_rng([_LAYOUT, seed]))
    return World(things, scene.light)


def open_capture(settings: SceneSettings, cache: Path | None = None) -> Capture:
    """Build and photograph, or find the photographs; sweeps over levels, faults and methods ask for the same ones again.

    Args:
        settings: Of the scene; its points and faults do not matter here.
        cache: Folder that keeps photographs between processes; what nobody uses of them then leaves the memory, else the last two captures stay.
    """
    same = replace(settings, points=0, faults=NO_NOISE)
    return _kept(same) if cache is None else _open(same, cache)


@functools.lru_cache(maxsize=2)
def _kept(settings: SceneSettings) -> Capture:
    return _open(settings, None)


def _open(settings: SceneSettings, cache: Path | None) -> Capture:
    world = open_world(settings)
    train, test = moments(settings.train_views, settings.test_views)
    order = np.argsort(np.argsort(np.concatenate([train, test])))
    places = []
    for position, moment in zip(
        order.tolist(), np.concatenate([train, test]).tolist(), strict=True
    ):
        held_out = len(places) >= settings.train_views
        number = len(places) - settings.train_views * held_out
        rng = np.random.default_rng([_WALK, settings.seed, int(held_out), number])
        if not settings.scene.outdoors:
            camera = camera_at(moment, rng, settings.width, settings.height)
        else:
            stop = stop_at(
                settings.scene.stage,
                number,
                settings.train_views,
                settings.test_views if held_out else 0,
            )
            camera = held(stop, rng, settings.width, settings.height)
        places.append((f"frame_{position + 1:05d}", number, camera))
    photos = _photographs(world, [camera for *_, camera in places], settings, cache)
    shots = [Shot(n, k, c, photo) for (n, k, c), photo in zip(places, photos, strict=True)]
    views = settings.train_views
    return Capture(world, tuple(shots[:views]), tuple(shots[views:]))


def _photographs(
    world: World, cameras: list[Camera], settings: SceneSettings, cache: Path | None
) -> list[TracedImage]:
    if cache is None:
        return _split(_taken(world, cameras, settings))
    file = cache / f"capture-{settings.fingerprint(level=0)}.npz"
    try:
        return _split(_read(file))
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        log.warning("synthetic: %s could not be read (%s) and is made again", file, error)
    stacks = _taken(world, cameras, settings)
    cache.mkdir(parents=True, exist_ok=True)
    write_atomically(file, lambda stream: np.savez(stream, allow_pickle=False, **stacks))
    _in_use.update((_key(file, field), stack) for field, stack in stacks.items())
    return _split(stacks)


_in_use: WeakValueDictionary[tuple[Path, int, int, str], np.ndarray] = WeakValueDictionary()
"""What stands in a file, while a scene holds a part of it: mask levels of one scene share a copy. A scene keeps the images and the
parts; the rest, more than half of the bytes, goes when it is made."""


def _key(file: Path, field: str) -> tuple[Path, int, int, str]:
    """What tells a field of a file from that of another that took its place."""
    state = file.stat()
    return file, state.st_mtime_ns, state.st_size, field


def _split(stacks: Mapping[str, np.ndarray]) -> list[TracedImage]:
    return [TracedImage(*arrays) for arrays in zip(*stacks.values(), strict=True)]


def _read(file: Path) -> dict[str, np.ndarray]:
    stacks = {}
    with Archive(file, "photographs of the scene") as kept:
        for field in _FIELDS:
            key = _key(file, field)
            stack = _in_use.get(key)
            if stack is None:
                stack = _in_use[key] = kept.read(field, "fiub")
            stacks[field] = stack
    return stacks


def _taken(world: World, cameras: list[Camera], settings: SceneSettings) -> dict[str, np.ndarray]:
    """All photographs, one array per field: hundreds of large ones are gigabytes, which pieces of the heap would keep after they went."""
    rng = np.random.default_rng([_EXPOSURE, settings.seed])
    gains = exposures(settings.scene.exposure, settings.train_views, rng).tolist()
    gains += [1.0] * settings.test_views  # held-out photographs come last
    stacks: dict[str, np.ndarray] = {}
    for place, taken in enumerate(zip(cameras, gains, strict=True)):
        photo = photograph(world, *taken)
        for field in _FIELDS:
            array = getattr(photo, field)
            if not place:
                stacks[field] = np.empty((len(cameras), *array.shape), array.dtype)
            stacks[field][place] = array
    return stacks


def regions(
    world: World, photo: TracedImage, levels: Collection[int] = LEVELS
) -> tuple[dict[int, Int[np.ndarray, "h w"]], dict[int, dict[int, Region]]]:
    """Region number per pixel at levels 1 (subpart), 2 (part) and 3 (whole), and what the regions of the wanted `levels` are."""
    part = photo.part.astype(np.int64)
    numbers = {3: world.thing_of_part[part], 2: part, 1: part * _PATCHES + photo.patch}
    findable = np.array([thing.masked for thing in world.things])[numbers[3]]
    place = np.concatenate([np.arange(len(thing.parts)) for thing in world.things])

    names = {
        level: {
            n: _region(world, place, level, n) for n in np.unique(numbers[level][findable]).tolist()
        }
        for level in levels
    }
    return numbers, names


def _region(world: World, place: Int[np.ndarray, " p"], level: int, number: int) -> Region:
    """What a region is; `place` is that of every part within its thing."""
    if level == 3:
        return Region(world.things[number].name, "whole")
    part, patch = (number, None) if level == 2 else divmod(number, _PATCHES)
    word = world.things[world.thing_of_part[part]].name
    return Region(word, f"{word}, part {place[part]}, patch {patch}")
