"""LERF-OVS labels: one JSON a view, an object a polygon and a box.

{"info": {"name": "frame_00001.jpg", "width": 988, "height": 730},
 "objects": [{"category": "plate", "segmentation": [[x, y], ...], "bbox": [x1, y1, x2, y2]}]}
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64
from PIL import Image, ImageDraw

from vlgs.data.diagnostics import Fault, SceneError, warning
from vlgs.data.untrusted.text import read_json

_MOST_CORNERS = 1_000_000
_CROSSING = 500
"""Corners up to which a crossing is looked for, at a cost that goes with their square; beyond, the even-odd rule is not warned of."""
_MOST_PIXELS = 1 << 31
"""Categories times pixels of an image: 170 categories on 12 megapixels. Each category becomes a mask."""


@dataclass(frozen=True)
class LabelledObject:
    """One instance."""

    category: str
    polygon: Float64[np.ndarray, "p 2"]
    """Corners in pixels of the JSON's image size, pixel indices as the labelling tools write them."""
    box: Float64[np.ndarray, " 4"]
    """``(x1, y1, x2, y2)`` in the same pixels, sorted."""


@dataclass(frozen=True)
class LabelledImage:
    """One JSON file."""

    path: Path
    width: int
    height: int
    objects: tuple[LabelledObject, ...]

    @property
    def files(self) -> tuple[Path, ...]:
        """Everything that was read."""
        return (self.path,)

    @property
    def categories(self) -> tuple[str, ...]:
        """What is labelled in the image, in the file's order."""
        return tuple(self._by_category)

    def mask(self, category: str) -> Bool[np.ndarray, "h w"]:
        """Union of the instances of a category, at the JSON's image size."""
        polygons = [item.polygon for item in self._by_category[category]]
        return fill_polygons(polygons, self.width, self.height)

    def boxes(self) -> dict[str, Float64[np.ndarray, "b 4"]]:
        """Category -> one box per instance, in the file's order."""
        return {
            category: np.stack([item.box for item in items])
            for category, items in self._by_category.items()
        }

    @cached_property
    def _by_category(self) -> dict[str, list[LabelledObject]]:
        grouped: dict[str, list[LabelledObject]] = {}
        for item in self.objects:
            grouped.setdefault(item.category, []).append(item)
        return grouped


@runtime_checkable
class ObjectImage(Protocol):
    """Labelled objects of one image: `LabelledImage`, or `vlgs.data.labels.folders.MaskedImage`."""

    @property
    def width(self) -> int: ...  # noqa: D102
    @property
    def height(self) -> int: ...  # noqa: D102
    @property
    def files(self) -> tuple[Path, ...]: ...  # noqa: D102
    @property
    def categories(self) -> tuple[str, ...]: ...  # noqa: D102
    def mask(self, category: str) -> Bool[np.ndarray, "h w"]: ...  # noqa: D102
    def boxes(self) -> dict[str, Float64[np.ndarray, "b 4"]]: ...  # noqa: D102


@dataclass(frozen=True)
class ObjectFolder:
    """A folder of labelled objects, opened."""

    files: Mapping[str, Path]
    """Stem -> JSON, or folder of masks."""
    sizes: Mapping[str, tuple[int, int]]
    """Stem -> width and height that the coordinates refer to."""
    images: Mapping[str, ObjectImage]
    classes: tuple[str, ...] | None = None
    """What can be asked for, where the folder says so; by default the categories of the images."""

    def by_position(self, names: Sequence[str]) -> "ObjectFolder":
        """The same labels for the n-th of the images where they are called ``frame_<n>``, n from 1.

        So GAGS and LangSplatV2 number their labels of images that have other names. Labels that have the stem of
        an image, or no such number, stay as they are.

        Args:
            names: Stems of all images, in order.
        """
        stems = {}
        for stem in self.files:
            number = re.fullmatch(r"frame_(\d+)", stem)
            known = number and stem not in names and 1 <= int(number[1]) <= len(names)
            stems[stem] = names[int(number[1]) - 1] if number and known else stem
        if len(set(stems.values())) < len(stems):
            return self  # numbers and names of one image: what belongs to no image is told as such
        return replace(
            self,
            files={stems[stem]: file for stem, file in self.files.items()},
            sizes={stems[stem]: size for stem, size in self.sizes.items()},
            images={stems[stem]: image for stem, image in self.images.items()},
        )


def open_objects(folder: Path) -> tuple[ObjectFolder, tuple[Fault, ...]]:
    """Read every JSON of a folder; see `vlgs.data.labels.open_labels`."""
    images: dict[str, LabelledImage] = {}
    faults: list[Fault] = []
    for path in sorted(folder.glob("*.json")):
        image, found = read_labelled_image(path)
        faults += found
        if image is not None:
            images[path.stem] = image
    files = {stem: image.path for stem, image in images.items()}
    sizes = {stem: (image.width, image.height) for stem, image in images.items()}
    return ObjectFolder(files, sizes, images), tuple(faults)


def read_labelled_image(path: Path) -> tuple[LabelledImage | None, tuple[Fault, ...]]:
    """One JSON file and what is wrong with it; None if it cannot be used at all."""
    try:
        content = read_json(path, "LERF-OVS labels (info, objects)")
        info, listed = content["info"], content["objects"]
        width, height, name = info["width"], info["height"], info.get("name", path.name)
        if not isinstance(listed, list) or not isinstance(name, str):
            raise TypeError("objects is not a list, or info.name is not a text")
    except SceneError as error:
        return None, (error.fault,)
    except (KeyError, TypeError, AttributeError) as error:
        what = (
            f"content must be LERF-OVS labels (info, objects), got {type(error).__name__}: {error}"
        )
        return None, (Fault(str(path), what),)
    if not all(type(side) is int and 0 < side <= 1 << 16 for side in (width, height)):
        what = f"info.width and info.height must be pixels, got {width!r} and {height!r}"
        return None, (Fault(str(path), what),)
    faults, objects = [], []
    known: set[tuple[str, bytes]] = set()
    if Path(name).stem != path.stem:
        faults.append(warning(path, f"info.name must be the file's own stem, got {name!r}"))
    for number, entry in enumerate(listed):
        item, found = _read_object(entry, (width, height))
        where = f"object {number}"
        faults += [Fault(str(path), f.what, f.advice, where, f.severity) for f in found]
        if item is None:
            continue
        if (same := (item.category, item.polygon.tobytes())) in known:
            faults.append(
                warning(path, f"objects must differ, got {item.category!r} twice", where=where)
            )
        else:
            known.add(same)
            objects.append(item)
    categories = len({item.category for item in objects})
    if categories * width * height > _MOST_PIXELS:
        what = (
            f"categories times pixels must be at most {_MOST_PIXELS}, got {categories} categories on "
            f"{width} x {height} pixels"
        )
        advice = "name fewer categories, or label a scaled copy of the image"
        return None, (*faults, Fault(str(path), what, advice))
    return LabelledImage(path, width, height, tuple(objects)), tuple(faults)


def fill_polygons(
    polygons: Iterable[Float64[np.ndarray, "_ 2"]], width: int, height: int
) -> Bool[np.ndarray, "h w"]:
    """Pixels inside polygons or on their outlines, corners cut to whole pixels, as the LERF-OVS evaluation fills them.

    Where an outline crosses itself the even-odd rule decides; what another polygon has filled stays filled.

    Example:
        >>> int(fill_polygons([np.array([[1.0, 1.0], [3.9, 1.0], [3.9, 2.0], [1.0, 2.0]])], 8, 8).sum())
        6
    """
    canvas = Image.new("L", (width, height))
    draw = ImageDraw.Draw(canvas)
    for polygon in polygons:
        corners = polygon.astype(np.int64).ravel().tolist()  # cut towards zero
        draw.polygon(corners, fill=1, outline=1)
    return np.asarray(canvas, bool)


def _read_object(entry: Any, size: tuple[int, int]) -> tuple[LabelledObject | None, list[Fault]]:
    """One object; None where it has no category, polygon or box to speak of. The faults carry no file yet."""
    if not isinstance(entry, dict):
        return None, [Fault("", f"object must be a mapping, got {type(entry).__name__}")]
    category = entry.get("category")
    if not isinstance(category, str) or not category.strip():
        return None, [Fault("", f"category must be a word, got {category!r}")]
    polygon = _numbers(entry.get("segmentation"), columns=2)
    if polygon is None or not 3 <= len(polygon) <= _MOST_CORNERS:
        got = entry.get("segmentation") if polygon is None else f"{len(polygon)} corners"
        what = f"{category}: segmentation must be one polygon of 3 or more finite corners, got {str(got)[:80]}"
        return None, [Fault("", what)]
    box = _numbers(entry.get("bbox"), columns=None)
    if box is None or box.shape != (4,):
        what = f"{category}: bbox must be four finite numbers, got {str(entry.get('bbox'))[:80]}"
        return None, [Fault("", what)]
    if np.abs(polygon).max() > 1e6 or np.abs(box).max() > 1e6:
        return None, [Fault("", f"{category}: coordinates must be pixels, got values over 1000000")]
    box = np.concatenate([np.minimum(box[:2], box[2:]), np.maximum(box[:2], box[2:])])
    item = LabelledObject(category, polygon, box)
    return item, list(_geometry_faults(item, size))


def _geometry_faults(item: LabelledObject, size: tuple[int, int]) -> Iterator[Fault]:
    """What is wrong with the shape of an object, worst first."""
    low, high = item.polygon.min(axis=0), item.polygon.max(axis=0)
    if (high < 0).any() or (low >= size).any():
        what = f"{item.category}: polygon must lie in the image of {size[0]} x {size[1]}, got {low} to {high}"
        yield Fault("", what)
    elif (low < -2).any() or (high > np.add(size, 2)).any():
        yield warning("", f"{item.category}: polygon must lie in the image, got {low} to {high}")
    bounds = np.concatenate([low, high])
    swapped = bounds[[1, 0, 3, 2]]
    if np.abs(bounds - item.box).max() > 5:
        guess = "x and y are swapped" if np.abs(swapped - item.box).max() <= 5 else "they disagree"
        what = f"{item.category}: bbox must bound the polygon {bounds}, got {item.box}"
        yield warning("", what, guess)
    x, y = item.polygon.T
    crossing = len(item.polygon) <= _CROSSING and crosses_itself(item.polygon)
    if abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) < 1 and not crossing:
        what = f"{item.category}: polygon must enclose an area, got corners on a line"
        yield warning("", what, "its outline is what is labelled")
    if crossing:
        what = f"{item.category}: polygon must not cross itself, got a crossing"
        yield warning("", what, "the even-odd rule fills it")


def crosses_itself(polygon: Float64[np.ndarray, "p 2"]) -> bool:
    """Whether two edges of a closed polygon cross in a point that is inside both.

    Edges that only touch do not count: labelling tools write them.
    """
    edge = np.roll(polygon, -1, axis=0) - polygon
    to = polygon[None] - polygon[:, None]  # [i, j]: from corner i to corner j
    # Side of edge i on which corner j lies; 0 for its own two.
    side = np.sign(edge[:, None, 0] * to[..., 1] - edge[:, None, 1] * to[..., 0])
    side[np.arange(len(edge)), np.arange(1, len(edge) + 1) % len(edge)] = 0
    apart = side * np.roll(side, -1, axis=1) < 0  # edge j has its ends on both sides of edge i
    return bool((apart & apart.T).any())


def _numbers(value: Any, columns: int | None) -> np.ndarray | None:
    """Finite float64 of a list of numbers, or of a list of lists of `columns` numbers; None if it is neither."""
    rows = value if columns is not None else [value]
    width = columns if columns is not None else 4
    if not isinstance(rows, list) or not all(isinstance(r, list) and len(r) == width for r in rows):
        return None
    if not all(type(number) in (int, float) for row in rows for number in row):
        return None
    try:
        array = np.array(rows, np.float64).reshape(-1, width)
    except OverflowError:
        return None
    if not np.isfinite(array).all():
        return None
    return array if columns is not None else array[0]
