"""Image files of a few formats, recognised by their content. A file that would decode to far too many pixels is refused."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.untrusted import COPY_AGAIN, file_size

_FORMATS = ("JPEG", "PNG", "BMP", "DIB", "TIFF", "WEBP")
"""Pillow would also open some that start another program (EPS). Phones' MPO comes as JPEG."""

_UNREADABLE = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    EOFError,
    OverflowError,
    MemoryError,
    RuntimeError,
    NotImplementedError,
    AttributeError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
    UserWarning,
)
"""What Pillow raises on a damaged file, besides what it is documented to raise; the last where warnings are errors."""

_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16L": 2, "I;16B": 2}
"""Bytes that Pillow takes for a pixel, where it is not four."""
_FREE = 64 << 20
"""Decoded bytes that any file may have: a photograph of 16 megapixels."""
_RATIO = 128
"""Beyond that, decoded bytes per byte of the file. A photograph has 4 to 30, and a drawing seldom more than 100."""
_SCANS = 100
"""A progressive JPEG has about ten passes over its pixels; thousands of empty ones would take hours."""


@contextmanager
def picture(path: Path, decode: bool = False) -> Iterator[Image.Image]:
    """An image file, opened; damage that is found while the context is open is told as that of the file.

    Args:
        path: The file.
        decode: Whether pixels will be asked for.

    Raises:
        SceneError: If it cannot be read, or would unfold to more than such a file can mean.
    """
    size = 0
    try:
        size = file_size(path)
        with Image.open(path, formats=_FORMATS) as image:
            _require_plausible(path, image, size)
            if decode and image.format in ("JPEG", "MPO"):
                _require_few_scans(path)
            yield image
    except SceneError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        what = f"pixels must be at most 179 million, got another number ({error})"
        raise SceneError(Fault(str(path), what, "scale the image down")) from error
    except _UNREADABLE as error:
        what = f"content must be a whole image, got {size} bytes that do not decode ({error})"
        raise SceneError(Fault(str(path), what, "copy the file again")) from error


def _require_plausible(path: Path, image: Image.Image, size: int) -> None:
    width, height = image.size
    decoded = width * height * _BYTES.get(image.mode, 4)
    if decoded > max(_FREE, _RATIO * size):
        what = (
            f"image of {size} bytes must have at most {max(_FREE, _RATIO * size) // 2**20} MiB of pixels, "
            f"got {decoded // 2**20} MiB ({width} x {height})"
        )
        advice = "a photograph has more detail: scale it down, or save it less compressed"
        raise SceneError(Fault(str(path), what, advice))


def _require_few_scans(path: Path) -> None:
    scans = path.read_bytes().count(b"\xff\xda")  # cannot occur among coded pixels
    if scans > _SCANS:
        what = f"JPEG must have at most {_SCANS} scans, got {scans}"
        raise SceneError(Fault(str(path), what, COPY_AGAIN))
