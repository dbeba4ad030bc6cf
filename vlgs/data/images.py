"""Image files -> uint8 RGB in the geometry of their COLMAP camera."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image, ImageOps
from torch import Tensor

from vlgs.data.diagnostics import Fault, SceneError, listing, warning
from vlgs.data.untrusted.pictures import picture

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})

_ORIENTATION = 0x0112

_DECODED = 4
"""Number of photographs that are searched for transparent pixels."""


@dataclass(frozen=True)
class Photograph:
    """An image file whose header was read, and how its pixels are to be taken."""

    path: Path
    width: int
    """Of what `read_photograph` returns."""
    height: int
    turned: bool
    """Whether the EXIF orientation is applied."""
    tagged: bool
    """Whether the file carries an EXIF orientation at all."""
    alpha: bool = False
    """Whether the file has an alpha channel or a transparent colour."""


def open_photograph(path: Path, camera_size: tuple[int, int]) -> Photograph:
    """Read the header of an image and compare its size with that of its camera.

    COLMAP ignores the EXIF orientation, so pixels are taken as stored wherever they fit the camera; the orientation is
    applied only where nothing else fits, which is how a camera made by another tool is told apart.

    Args:
        path: The file.
        camera_size: Width and height of the COLMAP camera; the image may be a scaled copy (``images_4``).

    Raises:
        SceneError: If the file cannot be read or has another shape than the camera.
    """
    with picture(path) as image:
        width, height = image.size
        orientation = image.getexif().get(_ORIENTATION, 1)
        mode, alpha = image.mode, image.has_transparency_data
    if mode in ("I", "F"):
        raise SceneError(Fault(str(path), f"pixels must be 8 or 16 bit integers, got mode {mode}"))
    tagged = orientation not in (0, 1)
    if is_copy_of((width, height), camera_size):
        return Photograph(path, width, height, turned=False, tagged=tagged, alpha=alpha)
    if orientation in (5, 6, 7, 8) and is_copy_of((height, width), camera_size):
        return Photograph(path, height, width, turned=True, tagged=tagged, alpha=alpha)
    expected = f"{camera_size[0]} x {camera_size[1]} as its camera, or a scaled copy of that"
    advice = "take the images that COLMAP saw"
    raise SceneError(Fault(str(path), f"size must be {expected}, got {width} x {height}", advice))


def read_photograph(photograph: Photograph) -> UInt8[Tensor, "h w 3"]:
    """Decode the whole file. 16 bit becomes 8, grey becomes three equal channels, transparency lies on black.

    Raises:
        SceneError: If the file is truncated or damaged.
    """
    with picture(photograph.path, decode=True) as image:
        rgb = _to_rgb(ImageOps.exif_transpose(image) if photograph.turned else image)
    return torch.from_numpy(np.array(rgb))


def transparency_warnings(photographs: Sequence[Photograph], folder: Path) -> Iterator[Fault]:
    """Say that transparent pixels become black, which is trained like any other colour.

    A few of the files with an alpha channel are decoded: many have one and are opaque all over.
    """
    channels = [photograph for photograph in photographs if photograph.alpha]
    step = -(-len(channels) // _DECODED) or 1
    holes = [p.path.name for p in channels[::step] if _has_transparent_pixels(p.path)]
    if holes:
        what = f"photographs should be opaque, got transparent pixels in {listing(holes)}"
        if len(channels) > 1:
            what += f" (an alpha channel in {len(channels)} of {len(photographs)})"
        advice = "they are laid on black, which is learnt as what is there: lay them on the background that you want"
        yield warning(folder, what, advice)


def _has_transparent_pixels(path: Path) -> bool:
    try:
        with picture(path, decode=True) as image:
            return bool(np.asarray(image.convert("RGBA").getchannel("A")).min(initial=255) < 255)
    except SceneError:  # said where it is read
        return False


def is_copy_of(size: tuple[int, int], camera: tuple[int, int]) -> bool:
    """Whether an image of this size shows what the camera shows: equal, or scaled with each side within a pixel.

    A size that is off by less than 3 % on both sides was cropped or padded, not scaled.

    Example:
        >>> is_copy_of((1237, 822), (4946, 3286)), is_copy_of((493, 365), (492, 364))
        (True, False)
    """
    if size == camera:
        return True
    ratios = [side / whole for side, whole in zip(size, camera, strict=True)]
    if any(abs(ratio - 1) < 0.03 for ratio in ratios):
        return False
    return any(
        abs(side - whole * ratio) <= 1
        for side, whole, ratio in zip(size, camera, reversed(ratios), strict=True)
    )


def _to_rgb(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I;16"):
        grey = np.asarray(image).astype(np.uint32)
        return Image.fromarray(((grey * 255 + 32767) // 65535).astype(np.uint8)).convert("RGB")
    if image.has_transparency_data:
        rgba = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", rgba.size, (0, 0, 0, 255)), rgba).convert(
            "RGB"
        )
    return image.convert("RGB")
