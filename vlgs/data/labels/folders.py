"""Labels as one binary mask per class and image, in the two layouts of two releases.

3D-OVS: ``classes.txt`` (a class per line) and ``<stem>/<class>.png``.
GOI on Mip-NeRF 360: ``<prompt>/masks/<stem>.png``.

A pixel that is neither black nor transparent belongs to the class. There are no boxes: a hit of the localisation is a pixel of the mask.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from vlgs.data.diagnostics import Fault, SceneError, listing, warning
from vlgs.data.labels.objects import ObjectFolder
from vlgs.data.labels.pictures import find_pngs, marked
from vlgs.data.untrusted.pictures import picture
from vlgs.data.untrusted.text import read_text


@dataclass(frozen=True)
class MaskedImage:
    """The masks of one image, on disk."""

    path: Path
    """What a fault of the whole image is reported of."""
    width: int
    height: int
    by_category: Mapping[str, Path]

    @property
    def files(self) -> tuple[Path, ...]:
        """Everything that is read."""
        return tuple(self.by_category.values())

    @property
    def categories(self) -> tuple[str, ...]:
        """Classes that the image has a mask of."""
        return tuple(self.by_category)

    def mask(self, category: str) -> Bool[np.ndarray, "h w"]:
        """The mask of a category.

        Raises:
            SceneError: If the file does not decode or has changed its size.
        """
        return self._read(self.by_category[category])

    def boxes(self) -> dict[str, Float64[np.ndarray, "b 4"]]:
        """None."""
        return {}

    def _read(self, path: Path) -> Bool[np.ndarray, "h w"]:
        with picture(path, decode=True) as image:
            pixels = marked(image)
        if pixels.shape != (self.height, self.width):
            what = f"size must be {self.width} x {self.height}, got {pixels.shape[::-1]}"
            raise SceneError(Fault(str(path), what))
        return pixels


def open_class_folders(folder: Path) -> tuple[ObjectFolder | None, tuple[Fault, ...]]:
    """3D-OVS's ``segmentations``; classes come sorted, as the original evaluation has them."""
    path = folder / "classes.txt"
    try:
        lines = read_text(path).splitlines()
    except SceneError as error:
        return None, (error.fault,)
    classes = tuple(sorted(line.strip() for line in lines if line.strip()))
    if not classes or len(set(classes)) < len(classes):
        what = f"classes must be unique names, one per line, got {listing(classes)}"
        return None, (Fault(str(path), what),)
    faults: list[Fault] = []
    found: dict[str, dict[str, Path]] = {}
    for mask in find_pngs(folder, "*/*"):
        if mask.stem in classes:
            found.setdefault(mask.parent.name, {})[mask.stem] = mask
        else:
            what = f"mask must be of a class in classes.txt, got {mask.stem!r}"
            faults.append(warning(mask, what, "it is not tested"))
    return _open(folder, classes, found, faults)


def open_prompt_folders(folder: Path) -> tuple[ObjectFolder | None, tuple[Fault, ...]]:
    """GOI's labels of one scene; the classes are the prompts."""
    found: dict[str, dict[str, Path]] = {}
    for mask in find_pngs(folder, "*/masks/*"):
        found.setdefault(mask.stem, {})[mask.parents[1].name] = mask
    classes = tuple(sorted({category for masks in found.values() for category in masks}))
    return _open(folder, classes, found, [])


def _open(
    folder: Path,
    classes: tuple[str, ...],
    found: Mapping[str, Mapping[str, Path]],
    faults: list[Fault],
) -> tuple[ObjectFolder | None, tuple[Fault, ...]]:
    """Read the headers; every mask of an image has to have one size."""
    images: dict[str, MaskedImage] = {}
    for stem, masks in sorted(found.items()):
        sizes: dict[Path, tuple[int, int]] = {}
        for mask in masks.values():
            try:
                with picture(mask) as image:
                    sizes[mask] = image.size
            except SceneError as error:
                faults.append(error.fault)
        if not sizes:
            continue
        first, size = next(iter(sizes.items()))
        faults += [
            Fault(str(mask), f"size must be {size} as {first.name}, got {own}")
            for mask, own in sizes.items()
            if own != size
        ]
        kept = {category: mask for category, mask in masks.items() if sizes.get(mask) == size}
        images[stem] = MaskedImage(first.parent, *size, kept)
    if not images:
        faults.append(Fault(str(folder), "masks must be at least 1, got 0"))
    return ObjectFolder(
        files={stem: image.path for stem, image in images.items()},
        sizes={stem: (image.width, image.height) for stem, image in images.items()},
        images=images,
        classes=classes,
    ), tuple(faults)
