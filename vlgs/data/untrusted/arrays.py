"""NumPy's npy and npz files. A small parser reads the headers, and sizes are compared with the bytes that are there."""

import math
import re
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.untrusted import COPY_AGAIN, file_size

_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER = 10_000
_ENTRY = re.compile(
    r"""['"](\w+)['"]\s*:\s*(?:['"]([^'"]*)['"]|(True|False)|\(([\d\s,L]*)\))\s*,?\s*"""
)
_DTYPE = re.compile(r"[<>|=]?[biufU]\d{1,9}")

_FREE = 64 << 20
"""Bytes that every member of an npz may have when it is decompressed."""
_RATIO = 50
"""Beyond that, largest ratio of decompressed to compressed bytes: 1 for vectors, 10 for words, but 1000 for zeros."""

_BROKEN_ZIP = (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError)
"""What zipfile raises on a damaged or encrypted archive."""


@dataclass(frozen=True)
class _Header:
    """What an npy says of itself."""

    dtype: np.dtype
    shape: tuple[int, ...]
    fortran: bool
    length: int
    """Bytes before the values."""

    @property
    def size(self) -> int:
        """Bytes of the values."""
        return math.prod(self.shape) * self.dtype.itemsize


def map_npy(path: Path) -> np.ndarray:
    """The array of an npy file of numbers, left on disk until it is looked at.

    Raises:
        FileNotFoundError: If there is no such file.
        SceneError: If it is not exactly an array of numbers.
    """
    length = file_size(path)

    def fail(what: str) -> SceneError:
        return SceneError(
            Fault(
                str(path), f"content must be a whole npy array of numbers, got {what}", COPY_AGAIN
            )
        )

    try:
        with path.open("rb") as stream:
            header = _read_header(stream.read, "fiu", fail)
    except OSError as error:
        raise fail(str(error)) from None
    if header.length + header.size != length:
        declared = f"{header.dtype} {list(header.shape)}"
        raise fail(f"{length - header.length} bytes of values for the {header.size} of {declared}")
    if not header.size:
        return np.empty(header.shape, header.dtype)
    order = "F" if header.fortran else "C"
    return np.memmap(path, header.dtype, "r", header.length, header.shape, order)


class Archive:
    """An npz, opened; a context. Its arrays are read one by one.

    Args:
        path: The file.
        expected: What it should hold, for errors.

    Raises:
        FileNotFoundError: If there is no such file.
        SceneError: If it is no zip.
    """

    def __init__(self, path: Path, expected: str) -> None:
        self.path, self.expected = path, expected
        self.bytes = file_size(path)
        try:
            self._zip = zipfile.ZipFile(path)
        except _BROKEN_ZIP as error:
            raise self.fail(f"{type(error).__name__}: {error}") from None
        self._members = {info.filename: info for info in self._zip.infolist()}

    def __enter__(self) -> "Archive":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._zip.close()

    def __contains__(self, name: str) -> bool:
        return f"{name}.npy" in self._members

    def read(self, name: str, kinds: str = "fiu") -> np.ndarray:
        """One array, checked to the last byte and against its checksum.

        Args:
            name: Of the array.
            kinds: Kinds of dtype that it may have; ``U`` is text.

        Raises:
            SceneError: If it is not there, damaged, or unfolds to more than such a file can mean.
        """
        if name not in self:
            raise self.fail(f"no array {name}")
        info = self._members[f"{name}.npy"]
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise self.fail(f"{name} under a compression that NumPy does not write")
        # What the directory says is not believed either: a member cannot take more of the file than there is.
        most = max(_FREE, _RATIO * min(info.compress_size, self.bytes))
        if info.file_size > most:
            advice = "write it again with np.savez, not compressed, if it is meant so"
            what = f"{name} that unfolds from {info.compress_size} bytes to {info.file_size}"
            raise self.fail(what, advice)

        def fail(what: str) -> SceneError:
            return self.fail(f"{name} with {what}")

        try:
            with self._zip.open(info) as stream:
                header = _read_header(stream.read, kinds, fail)
                if header.length + header.size != info.file_size:
                    declared = f"{header.dtype} {list(header.shape)}"
                    raise fail(f"{info.file_size - header.length} bytes of values for {declared}")
                # The array owns its memory, so that it is alive exactly while a part of it is in use.
                values = np.empty(header.shape, header.dtype, "F" if header.fortran else "C")
                _fill(stream.read, values.ravel("K").view(np.uint8), fail)
        except SceneError:
            raise
        except _BROKEN_ZIP as error:
            raise fail(f"{type(error).__name__}: {error}") from None
        return values

    def fail(self, what: str, advice: str = COPY_AGAIN) -> SceneError:
        """The error that the content is something else."""
        return SceneError(
            Fault(str(self.path), f"content must be {self.expected}, got {what}", advice)
        )


def _fill(
    read: Callable[[int], bytes], values: np.ndarray, fail: Callable[[str], SceneError]
) -> None:
    """Read until `values` is full and nothing is left, which is when zipfile looks at the checksum."""
    view, filled = values.data, 0
    while filled < len(view):
        got = read(min(1 << 20, len(view) - filled))
        if not got:
            raise fail(f"{filled} bytes of values instead of {len(view)}")
        view[filled : filled + len(got)] = got
        filled += len(got)
    if read(1):
        raise fail("bytes after the values")


def _read_header(
    read: Callable[[int], bytes], kinds: str, fail: Callable[[str], SceneError]
) -> _Header:
    start = read(8)
    if len(start) < 8 or start[:6] != _MAGIC or start[6] not in (1, 2, 3):
        raise fail(f"a file that begins with {start!r}")
    width = 2 if start[6] == 1 else 4
    length = int.from_bytes(read(width), "little")
    if length > _LONGEST_HEADER:
        raise fail(f"a header of {length} bytes")
    text = read(length).decode("latin-1").strip()
    entries = {m[1]: m for m in _ENTRY.finditer(text)}
    if set(entries) != {"descr", "fortran_order", "shape"} or _ENTRY.sub("", text) != "{}":
        raise fail(f"the header {text[:80]!r}")
    dtype, order, shape = (
        entries[k][i] for k, i in (("descr", 2), ("fortran_order", 3), ("shape", 4))
    )
    if dtype is None or order is None or shape is None:
        raise fail(f"the header {text[:80]!r}")
    sides = [side.strip().rstrip("L") for side in shape.split(",") if side.strip()]
    if not all(side.isdecimal() and len(side) < 19 for side in sides) or len(sides) > 8:
        raise fail(f"the shape ({shape[:80]})")
    try:
        known = np.dtype(dtype) if _DTYPE.fullmatch(dtype) else None
    except TypeError:
        known = None
    if known is None or known.kind not in kinds or not known.itemsize:
        raise fail(f"values of type {dtype[:40]!r}")
    return _Header(known, tuple(map(int, sides)), order == "True", 8 + width + length)
