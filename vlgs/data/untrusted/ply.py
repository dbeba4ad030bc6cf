"""The vertices of a PLY file, as columns. The counts of the header are compared with the bytes that are there."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.untrusted import COPY_AGAIN, file_size, read_bytes

_LONGEST_HEADER = 1 << 18
"""Bytes. Gaussians with 1 536 language channels have 50 000."""

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass
class _Element:
    name: str
    count: int
    columns: dict[str, str] = field(default_factory=dict)
    """Property -> NumPy type without byte order, or ``list``."""


@dataclass(frozen=True)
class _Header:
    order: str
    """Byte order, ``<`` or ``>``; ``=`` is text."""
    elements: tuple[_Element, ...]
    length: int
    """Bytes, the end of its last line included."""


def read_vertices(path: Path) -> Mapping[str, np.ndarray]:
    """Property -> column of the element ``vertex``, numeric ones only; binary files stay on disk until they are looked at.

    Raises:
        FileNotFoundError: If there is no such file.
        SceneError: If it is no whole PLY file, or has no vertices that can be reached.
    """
    size = file_size(path)
    with path.open("rb") as stream:
        header = _parse(path, stream.read(_LONGEST_HEADER))
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise SceneError(Fault(str(path), f"must have an element vertex, got {names[:10]}"))
    place = names.index("vertex")
    vertex, before = header.elements[place], header.elements[:place]
    if any("list" in element.columns.values() for element in before):
        what = "vertices must come before elements with lists, got them after"
        raise SceneError(Fault(str(path), what, "write the file again with vertices first"))
    columns = {name: kind for name, kind in vertex.columns.items() if kind != "list"}
    if not columns or (len(columns) < len(vertex.columns) and header.order != "="):
        return {}  # rows of unknown length, of which nothing that is asked for can be part
    if header.order == "=":
        return _read_text(path, header, vertex, sum(element.count for element in before))
    row = np.dtype([(name, header.order + kind) for name, kind in columns.items()])
    start = header.length + sum(
        e.count * sum(np.dtype(kind).itemsize for kind in e.columns.values()) for e in before
    )
    end = start + vertex.count * row.itemsize
    if end > size or (end < size and place == len(names) - 1):
        what = f"{vertex.count} vertices of {row.itemsize} bytes in {size - start} bytes"
        raise _fail(path, what)
    if not vertex.count:
        return {name: np.empty(0, kind) for name, kind in columns.items()}
    rows = np.memmap(path, row, mode="r", offset=start, shape=(vertex.count,))
    return {name: rows[name] for name in columns}


def _read_text(
    path: Path, header: _Header, vertex: _Element, skipped: int
) -> Mapping[str, np.ndarray]:
    """Rows of numbers, one a line."""
    if "list" in vertex.columns.values():
        return {}
    lines = read_bytes(path)[header.length :].splitlines()
    rows = lines[skipped : skipped + vertex.count]
    if len(rows) < vertex.count:
        raise _fail(path, f"{len(rows)} lines for {vertex.count} vertices")
    width = len(vertex.columns)
    try:
        values = np.array([list(map(float, line.split())) for line in rows])
    except ValueError as error:
        raise _fail(path, f"lines that are not {width} numbers each ({error})") from None
    if not vertex.count:
        values = values.reshape(0, width)
    if values.ndim != 2 or values.shape[1] != width:
        raise _fail(path, f"lines that are not {width} numbers each")
    return dict(zip(vertex.columns, values.T, strict=True))


def _parse(path: Path, start: bytes) -> _Header:
    """The header of a file that begins so."""
    opening = re.match(rb"ply(\r\n|\n|\r)", start)
    if not opening:
        raise _fail(path, f"a file that begins with {start[:8]!r}")
    end = re.search(rb"[\r\n]end_header" + opening[1], start)
    if not end:
        raise _fail(path, f"no end_header within the first {len(start)} bytes")
    lines = start[: end.start()].decode("latin-1").split(opening[1].decode())
    order, elements = None, []
    for number, line in enumerate(lines[1:], start=2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _ORDERS and order is None:
                order = _ORDERS[name]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,15}", count):
                elements.append(_Element(name, int(count)))
            case ["property", "list", kind, item, name] if (
                elements and {kind, item} <= _TYPES.keys()
            ):
                _add(path, number, elements[-1], name, "list")
            case ["property", kind, name] if elements and kind in _TYPES:
                _add(path, number, elements[-1], name, _TYPES[kind])
            case _:
                raise _fail(path, f"line {number} of the header: {line[:80]!r}")
    if order is None:
        raise _fail(path, "a header without a format")
    return _Header(order, tuple(elements), end.end())


def _add(path: Path, number: int, element: _Element, name: str, kind: str) -> None:
    if name in element.columns:
        raise _fail(path, f"line {number} of the header: property {name[:80]} for the second time")
    element.columns[name] = kind


def _fail(path: Path, got: str) -> SceneError:
    return SceneError(Fault(str(path), f"must be a complete PLY file, got {got}", COPY_AGAIN))
