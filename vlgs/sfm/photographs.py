"""The photographs of a folder, and which of them one camera took."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

from PIL import ExifTags, Image

from vlgs.data.diagnostics import SceneError, listing
from vlgs.data.images import SUFFIXES
from vlgs.data.untrusted.pictures import picture

Device = tuple[tuple[int, int], tuple[str, ...]]
"""Width and height; make, model and focal length from EXIF."""


def find_photographs(images: Path) -> dict[Device, list[str]]:
    """Names below the folder, in order, those together that one camera took as far as the files tell.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If a file does not read, or there are fewer than three, or two of one name.
    """
    if not images.is_dir():
        raise FileNotFoundError(f"sfm: images must be a folder of photographs, got {images}")
    paths = sorted(p for p in images.rglob("*") if p.suffix.lower() in SUFFIXES)
    groups: dict[Device, list[str]] = {}
    broken = []
    for path in paths:
        try:
            with picture(path) as image:
                device = image.size, _exif_camera(image)
        except SceneError as error:
            broken.append(f"{path.name} ({error.fault.what})")
            continue
        groups.setdefault(device, []).append(path.relative_to(images).as_posix())
    if broken:
        raise ValueError(f"sfm: photographs must be readable, got {listing(broken)}")
    if len(paths) < 3:
        raise ValueError(f"sfm: photographs must be at least 3, got {len(paths)} in {images}")
    stems = [path.stem for path in paths]
    if len(set(stems)) < len(stems):
        twice = sorted({stem for stem in stems if stems.count(stem) > 1})
        raise ValueError(
            f"sfm: photographs must have different names, got {listing(twice)} more than once"
        )
    return groups


def digest_photographs(images: Path, names: Iterable[str]) -> str:
    """Hash of the names and contents of photographs.

    Args:
        images: Their folder.
        names: Below it, in an order that is always the same.
    """
    hasher = hashlib.blake2b(digest_size=16)
    for name in names:
        with (images / name).open("rb") as stream:
            content = hashlib.file_digest(stream, "blake2b").digest()
        hasher.update(name.encode("utf-8", "surrogateescape") + b"\0" + content)
    return hasher.hexdigest()


def _exif_camera(image: Image.Image) -> tuple[str, ...]:
    """Make, model and focal length, as far as the file has them."""
    exif = image.getexif()
    values = (
        exif.get(ExifTags.Base.Make),
        exif.get(ExifTags.Base.Model),
        exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLength),
    )
    return tuple(map(str, values))
