"""The files of one view: read when needed, undistorted, and cached. They stand behind the read functions of `vlgs.types.View`."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int, Int32, Int64, Shaped, UInt8
from torch import Tensor

from vlgs.data.cache import PixelCache
from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.images import Photograph, read_photograph
from vlgs.data.labels import DenseFolder, ObjectFolder
from vlgs.data.labels.objects import ObjectImage
from vlgs.data.language import MaskFiles, read_mask_ids
from vlgs.data.lens import (
    Lens,
    covers_all,
    move_boxes,
    nearest_pixels,
    sampling_grid,
    shrink_pixels,
    undistort_pixels,
)
from vlgs.types import IGNORE_ID, Camera, DenseLabels, ObjectLabels, View


@dataclass(frozen=True)
class ViewSource:
    """Where the pixels of one view come from."""

    name: str
    camera: Camera
    """Of the output."""
    camera_size: tuple[int, int]
    """Width and height of the COLMAP camera, of which the image file may be a scaled copy."""
    photograph: Photograph
    lens: Lens
    cache: PixelCache
    labels: DenseFolder | ObjectFolder | None = None
    """The folder that has labels of this view."""
    masks: MaskFiles | None = None
    level: int = 0
    rows: Int32[np.ndarray, " r"] | None = None
    """Entry i + 1 is the row of `Scene.mask_vectors` that the view's mask id i has, or -1; the first one is for id -1."""
    keep: bool = True
    """Whether decoded pixels are kept; tables of the lens always are."""

    @property
    def decoded_bytes(self) -> int:
        """Of the photograph, and of the masks if there are any."""
        return self.camera.width * self.camera.height * (3 if self.rows is None else 3 + 4)

    def view(self) -> View:
        """This view with a reader for everything that it has."""
        objects = isinstance(self.labels, ObjectFolder)
        dense = isinstance(self.labels, DenseFolder)
        return View(
            name=self.name,
            camera=self.camera,
            read_image=self.read_image,
            read_masks=None if self.rows is None else self.read_masks,
            read_object_labels=self.read_object_labels if objects else None,
            read_dense_labels=self.read_dense_labels if dense else None,
            read_valid=None if covers_all(self.lens) else self.read_valid,
        )

    def read_image(self) -> UInt8[Tensor, "h w 3"]:
        """The photograph, undistorted bilinearly and then shrunk by area averages. Shared: do not write into it."""
        return self._decoded("image", self._make_image)

    def read_masks(self) -> Int[Tensor, "h w"]:
        """Row of `Scene.mask_vectors` per pixel, -1 where no mask lies (int32). Shared: do not write into it."""
        return self._decoded("masks", self._make_masks)

    def read_dense_labels(self) -> DenseLabels:
        """Class ids, `IGNORE_ID` where the photograph has no pixels."""
        return DenseLabels(self._decoded("labels", self._make_ids))

    def read_object_labels(self) -> ObjectLabels:
        """Masks and boxes of the labelled objects, moved to the output's pixels."""
        assert isinstance(self.labels, ObjectFolder)
        image = self.labels.images[self.name]
        size = image.width, image.height
        boxes = {
            category: torch.from_numpy(move_boxes(rows, size, self.lens)).float()
            for category, rows in image.boxes().items()
        }
        # One at a time: thousands of categories do not fit into memory side by side.
        return ObjectLabels(_Masks(image.categories, lambda c: self._warp_mask(image, c)), boxes)

    def read_valid(self) -> Bool[Tensor, "h w"]:
        """Whether the photograph covers a pixel."""
        return self._nearest(self.lens.file_size) >= 0

    def read_mask_ids(self, n_vectors: int) -> Int32[np.ndarray, "h w"]:
        """Row of the view's own vectors per output pixel, -1 where no mask lies.

        Raises:
            SceneError: As `vlgs.data.language.read_mask_ids`.
        """
        assert self.masks is not None
        return self.warp(read_mask_ids(self.masks, self.level, n_vectors), fill=-1)

    def warp(self, values: Shaped[np.ndarray, "mh mw"], fill: int) -> Shaped[np.ndarray, "h w"]:
        """The value of a map of any resolution at the nearest pixel, `fill` where the photograph has no pixels."""
        map_size = (values.shape[1], values.shape[0])
        if self.lens.distorted is None and map_size == self.lens.size:
            return values
        # NumPy's gather: torch's would wake its threads for a millisecond's work.
        index = self._nearest(map_size).numpy()
        warped = values.ravel().take(index, mode="clip")
        warped[index < 0] = fill
        return warped

    def _warp_mask(self, image: ObjectImage, category: str) -> Bool[Tensor, "h w"]:
        return torch.from_numpy(self.warp(image.mask(category), fill=0))

    def _decoded(self, what: str, make: Callable[[], Tensor]) -> Tensor:
        return self.cache.get((what, self.name), make) if self.keep else make()

    def _nearest(self, map_size: tuple[int, int]) -> Int64[Tensor, "h w"]:
        key = ("nearest", self.lens, map_size)
        return self.cache.get(key, lambda: nearest_pixels(self.lens, map_size))

    def _make_image(self) -> Tensor:
        pixels = read_photograph(self.photograph)
        self._require_size(pixels)
        if self.lens.distorted is not None:
            grid = self.cache.get(("grid", self.lens), lambda: sampling_grid(self.lens))
            pixels = undistort_pixels(pixels, grid)
        return shrink_pixels(pixels, self.lens.size)

    def _make_masks(self) -> Tensor:
        assert self.rows is not None
        return torch.from_numpy(self.rows.take(self.read_mask_ids(len(self.rows) - 1) + 1))

    def _make_ids(self) -> Tensor:
        assert isinstance(self.labels, DenseFolder)
        return torch.from_numpy(self.warp(self.labels.read_ids(self.name), fill=IGNORE_ID))

    def _require_size(self, pixels: Tensor) -> None:
        """Raise an error if the size has changed since the header was read: the file was replaced."""
        got = (pixels.shape[1], pixels.shape[0])
        if got != self.lens.file_size:
            what = f"size must still be {self.lens.file_size}, got {got}"
            raise SceneError(Fault(str(self.photograph.path), what))


class _Masks(Mapping[str, Bool[Tensor, "h w"]]):
    """Category -> mask, made when it is asked for."""

    def __init__(self, categories: Iterable[str], make: Callable[[str], Tensor]) -> None:
        self._categories = dict.fromkeys(categories)
        self._make = make

    def __getitem__(self, category: str) -> Bool[Tensor, "h w"]:
        if category not in self._categories:
            raise KeyError(category)
        return self._make(category)

    def __iter__(self) -> Iterator[str]:
        return iter(self._categories)

    def __len__(self) -> int:
        return len(self._categories)


def map_sizes(lens: Lens, camera_size: tuple[int, int]) -> list[tuple[int, int]]:
    """Sizes that a mask or label map of a view may have, in the geometry of its image file (not undistorted).

    It was made from the image file, or from the full-size original of a scaled copy, or from either after the rule of
    LangSplat's preprocessing that no image is higher than 1080 pixels. Another size would have to be guessed at.
    """
    sizes = [lens.file_size, camera_size]
    for width, height in (lens.file_size, camera_size):
        if height > 1080:
            sizes.append((int(width / (height / 1080)), 1080))
    return list(dict.fromkeys(sizes))
