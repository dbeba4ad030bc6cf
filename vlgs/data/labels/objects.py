"""LERF-OVS labels: one JSON a view, an object a polygon and a box (S. C.2).

{"info": {"name": "frame_00001.jpg", "width": 988, "height": 730},
 "objects": [{"category": "plate", "segmentation": [[x, y], ...], "bbox": [x1, y1, x2, y2]}]}
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64
from PIL import Image, ImageDraw

from vlgs.data.faults import Fault, warning

_MOST_CORNERS = 100_000


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
    def categories(self) -> frozenset[str]:
        """What is labelled in the image."""
        return frozenset(item.category for item in self.objects)

    def masks(self) -> dict[str, Bool[np.ndarray, "h w"]]:
        """Category -> union of its instances, at the JSON's image size."""
        merged: dict[str, np.ndarray] = {}
        for item in self.objects:
            mask = fill_polygon(item.polygon, self.width, self.height)
            merged[item.category] = merged.get(item.category, False) | mask
        return merged

    def boxes(self) -> dict[str, Float64[np.ndarray, "b 4"]]:
        """Category -> one box per instance, in the file's order."""
        rows: dict[str, list[np.ndarray]] = {}
        for item in self.objects:
            rows.setdefault(item.category, []).append(item.box)
        return {category: np.stack(boxes) for category, boxes in rows.items()}


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
    def categories(self) -> frozenset[str]: ...  # noqa: D102
    def masks(self) -> dict[str, Bool[np.ndarray, "h w"]]: ...  # noqa: D102
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

        So GAGS and LangSplatV2 number their labels of images that have other names (S. B.4). Labels that have the stem of
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
        content = json.loads(path.read_text(encoding="utf-8"))
        info, listed = content["info"], content["objects"]
        width, height, name = info["width"], info["height"], info.get("name", path.name)
        if not isinstance(listed, list) or not isinstance(name, str):
            raise TypeError("objects is not a list, or info.name is not a text")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        what = (
            f"content must be LERF-OVS labels (info, objects), got {type(error).__name__}: {error}"
        )
        return None, (Fault(str(path), what),)
    if not all(type(side) is int and 0 < side <= 1 << 16 for side in (width, height)):
        what = f"info.width and info.height must be pixels, got {width!r} and {height!r}"
        return None, (Fault(str(path), what),)
    faults, objects = [], []
    if Path(name).stem != path.stem:
        faults.append(warning(path, f"info.name must be the file's own stem, got {name!r}"))
    for number, entry in enumerate(listed):
        item, found = _read_object(entry, (width, height))
        where = f"object {number}"
        faults += [Fault(str(path), f.what, f.advice, where, f.severity) for f in found]
        if item is not None and any(_is_same(item, other) for other in objects):
            faults.append(
                warning(path, f"objects must differ, got {item.category!r} twice", where=where)
            )
        elif item is not None:
            objects.append(item)
    return LabelledImage(path, width, height, tuple(objects)), tuple(faults)


def fill_polygon(
    polygon: Float64[np.ndarray, "p 2"], width: int, height: int
) -> Bool[np.ndarray, "h w"]:
    """Pixels inside a polygon or on its outline, corners cut to whole pixels, as the LERF-OVS evaluation fills it.

    Where the outline crosses itself the even-odd rule decides.

    Example:
        >>> int(fill_polygon(np.array([[1.0, 1.0], [3.9, 1.0], [3.9, 2.0], [1.0, 2.0]]), 8, 8).sum())
        6
    """
    canvas = Image.new("L", (width, height))
    corners = [(int(x), int(y)) for x, y in polygon]
    ImageDraw.Draw(canvas).polygon(corners, fill=1, outline=1)
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
    if abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) < 1 and not crosses_itself(
        item.polygon
    ):
        what = f"{item.category}: polygon must enclose an area, got corners on a line"
        yield warning("", what, "its outline is what is labelled")
    if crosses_itself(item.polygon):
        what = f"{item.category}: polygon must not cross itself, got a crossing"
        yield warning("", what, "the even-odd rule fills it")


def crosses_itself(polygon: Float64[np.ndarray, "p 2"]) -> bool:
    """Whether two edges of a closed polygon cross in a point that is inside both.

    Edges that only touch do not count: labelling tools write them.
    """
    start, end = polygon, np.roll(polygon, -1, axis=0)
    edge = end - start

    def side(points: np.ndarray, i: int) -> np.ndarray:
        """Sign of the area that edge i spans with each of the points."""
        to = points - start[i]
        return np.sign(edge[i, 0] * to[:, 1] - edge[i, 1] * to[:, 0])

    for i in range(len(polygon) - 2):
        a, b = start[i + 2 :], end[i + 2 :]
        apart = side(a, i) * side(b, i) < 0
        if apart.any():
            j = np.flatnonzero(apart) + i + 2
            to_start, to_end = start[i] - start[j], end[i] - start[j]
            s = np.sign(edge[j, 0] * to_start[:, 1] - edge[j, 1] * to_start[:, 0])
            e = np.sign(edge[j, 0] * to_end[:, 1] - edge[j, 1] * to_end[:, 0])
            if (s * e < 0).any():
                return True
    return False


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


def _is_same(a: LabelledObject, b: LabelledObject) -> bool:
    return a.category == b.category and np.array_equal(a.polygon, b.polygon)
