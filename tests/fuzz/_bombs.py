"""Writers of the files of `tests.fuzz.bombs`, each of a few megabytes at most."""

import io
import json
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

Write = Callable[[Path], object]


def raw(data: bytes | str) -> Write:
    return lambda path: path.write_bytes(data.encode() if isinstance(data, str) else data)


def as_json(make: Callable[[], Any]) -> Write:
    return lambda path: path.write_text(json.dumps(make()))


def pipe(path: Path) -> None:
    os.mkfifo(path)


def ply(*lines: str, kind: str = "ascii", tail: bytes = b"1 2 3\n") -> Write:
    header = "\n".join(["ply", f"format {kind} 1.0", *lines, "end_header\n"])
    return raw(header.encode() + tail)


def npy(header: str | bytes, version: int = 1, values: bytes = bytes(64)) -> Write:
    text = header if isinstance(header, bytes) else header.encode()
    width = 2 if version == 1 else 4
    length = len(text).to_bytes(width, "little")
    return raw(b"\x93NUMPY" + bytes([version, 0]) + length + text + values)


def npy_of(shape: str, dtype: str = "<f4", order: str = "False") -> Write:
    return npy(f"{{'descr': '{dtype}', 'fortran_order': {order}, 'shape': {shape}, }}\n")


def _npy_bytes(shape: str, dtype: str, values: bytes) -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + values


def npz(embeddings: bytes, names: bytes | None = None, kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", kind, compresslevel=1) as archive:
        archive.writestr("names.npy", names or _npy_bytes("(1,)", "<U1", b"a\0\0\0"))
        archive.writestr("embeddings.npy", embeddings)
    return stream.getvalue()


def unfolding_npz(path: Path, kind: int = zipfile.ZIP_DEFLATED) -> None:
    path.write_bytes(npz(_npy_bytes("(1, 100000000)", "<f4", bytes(400_000_000)), kind=kind))


def declaring_npz(path: Path) -> None:
    """Sizes of 3 GB in the directory and in the header of the array."""
    data = npz(_npy_bytes("(750000000, 1)", "<f4", bytes(64)))
    at = data.rindex(b"PK\x01\x02")
    path.write_bytes(data[: at + 24] + struct.pack("<I", 3_000_000_100) + data[at + 28 :])


def wide_name_npz(path: Path) -> None:
    names = _npy_bytes("(3,)", "<U30000000", bytes(360_000_000))
    path.write_bytes(npz(_npy_bytes("(3, 1)", "<f4", bytes(12)), names))


def many_names_npz(path: Path) -> None:
    path.write_bytes(
        npz(_npy_bytes("(1, 1)", "<f4", bytes(4)), _npy_bytes("(1000000000,)", "<U0", b""))
    )


def many_members_npz(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(20_000):
            archive.writestr(f"{i}.npy", b"")


def flat(mode: str, size: tuple[int, int], format: str, **options: Any) -> Write:
    return lambda path: Image.new(mode, size).save(path, format, **options)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *chunks: Callable[[], bytes], color: int = 2) -> Write:
    def write(path: Path) -> None:
        header = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, color, 0, 0, 0))
        data = _chunk(b"IDAT", zlib.compress(bytes(100_000)))
        between = b"".join(chunk() for chunk in chunks)
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + between + data + _chunk(b"IEND", b""))

    return write


def unfolding_chunk(kind: bytes, prefix: bytes) -> Callable[[], bytes]:
    """Made when the file is written: it takes a second."""
    return lambda: _chunk(kind, prefix + zlib.compress(bytes(300_000_000), 1))


def jpeg_of_many_scans(path: Path) -> None:
    """The last scan of a progressive JPEG of 4 megapixels, 20 000 times."""
    stream = io.BytesIO()
    Image.new("L", (2304, 1728)).save(stream, "JPEG", progressive=True)
    data = stream.getvalue()
    scan = data[data.rindex(b"\xff\xda") : -2]
    path.write_bytes(data[:-2] + scan * 20_000 + data[-2:])


def declaring_jpeg(path: Path) -> None:
    stream = io.BytesIO()
    Image.new("RGB", (24, 18)).save(stream, "JPEG")
    data = stream.getvalue()
    at = data.index(b"\xff\xc0") + 5
    path.write_bytes(data[:at] + struct.pack(">HH", 9750, 13000) + data[at + 4 :])


def images_of_unknown_cameras(path: Path) -> None:
    pose = struct.pack("<7d", 1, 0, 0, 0, 0, 0, 0)
    rows = [
        struct.pack("<I", i) + pose + struct.pack("<I", 2**31 + i) + b"a\0" + bytes(8)
        for i in range(30_000)
    ]
    path.write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))


def many_cameras(path: Path) -> None:
    rows = [struct.pack("<IiQQ4d", i, 1, 24, 18, 20, 20, 12, 9) for i in range(40_000)]
    path.write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))


def labels(objects: Callable[[], list[dict]], width: int = 24, height: int = 18) -> Write:
    info = {"name": "a.jpg", "width": width, "height": height}
    return as_json(lambda: {"info": info, "objects": objects()})


def circle(corners: int) -> dict:
    turn = np.arange(corners) * (2 * np.pi / corners)
    outline = np.round(np.stack([12 + 8 * np.cos(turn), 9 + 8 * np.sin(turn)], axis=1), 2)
    return {"category": "plate", "segmentation": outline.tolist(), "bbox": [4, 1, 20, 17]}


def squares(count: int, categories: int) -> list[dict]:
    rng = np.random.default_rng(0)
    out = []
    for i in range(count):
        x, y = (round(float(v), 3) for v in rng.uniform(0, 14, 2))
        corners = [[x, y], [x + 3, y], [x + 3, y + 3], [x, y + 3]]
        box = [x, y, x + 3, y + 3]
        out.append({"category": f"thing {i % categories}", "segmentation": corners, "bbox": box})
    return out


def frames(count: int, path: str = "images/a.webp", shared: Any = None) -> Write:
    frame = {"transform_matrix": np.eye(4).tolist(), "w": 24, "h": 18, "fl_x": 20.0}
    return as_json(
        lambda: {**(shared or {}), "frames": [frame | {"file_path": path} for _ in range(count)]}
    )


class _Call:
    """Pickles as a call of something."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def pth(pickled: bytes, *members: tuple[str, bytes], kind: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", kind) as archive:
        parts = (("archive/data.pkl", pickled), ("archive/version", b"3\n"), *members)
        for name, data in parts:
            archive.writestr(name, data)
    return stream.getvalue()


def pth_of_call(function: Any, *arguments: Any) -> Write:
    return lambda path: path.write_bytes(pth(pickle.dumps(_Call(function, *arguments), 2)))


def pth_of_memo(path: Path) -> None:
    """An entry of the memo at 4 billion."""
    path.write_bytes(pth(b"\x80\x02K\x01r" + struct.pack("<I", 2**32 - 1) + b"."))


def pth_of_texts(path: Path) -> None:
    path.write_bytes(pth(b"\x80\x02]" + b"(" + b"K\x01" * 4_000_000 + b"e."))


def saved(make: Callable[[], Any]) -> Write:
    def write(path: Path) -> None:
        import torch

        torch.save(make(), path)

    return write


def folded(path: Path) -> None:
    import torch

    torch.save({"encoder.0.weight": torch.zeros(1000, 100_000)}, path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def empty_matrices() -> dict:
    import torch

    layers = {f"encoder.{3 * i}.weight": torch.zeros(1_000_000, 0) for i in range(3)}
    return layers | {f"decoder.{2 * i}.weight": torch.zeros(1_000_000, 0) for i in range(3)}


def safetensors(path: Path) -> None:
    from safetensors.torch import save_file

    save_file(empty_matrices(), path)


def stretched() -> Any:
    import torch

    return {"encoder.0.weight": torch.zeros(1).expand(1_000_000, 1_000_000)}


def legacy(path: Path) -> None:
    import torch

    torch.save({"a": torch.zeros(4)}, path, _use_new_zipfile_serialization=False)
    path.write_bytes(path.read_bytes().replace(b"K\x04N", b"\x8a\x05\0\0\0\0\x10N"))
