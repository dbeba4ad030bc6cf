"""``torch.save`` files of tensors and plain values, read without running anything that they hold."""

import codecs
import io
import pickle
import pickletools
import struct
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vlgs.files import write_atomically

_UNREADABLE = (
    OSError,
    pickle.UnpicklingError,
    RuntimeError,
    EOFError,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    AssertionError,
    struct.error,
    MemoryError,
    OverflowError,
    NotImplementedError,
    RecursionError,
    zipfile.BadZipFile,
)
"""What torch's restricted reader raises on a file that it does not know or does not trust."""


# 3DGS stores the scene's extent as NumPy left it: a scalar of one of these two types, under the module names of NumPy 1 and 2.
def _float_type(name: str, *_: object) -> np.dtype:
    """In place of ``numpy.dtype``, which would also take types of gigabytes."""
    if name not in ("f4", "f8"):
        raise ValueError(f"NumPy type must be f4 or f8, got {str(name)[:40]}")
    return np.dtype(name)


def _float(dtype: np.dtype, data: bytes) -> float:
    return float(np.frombuffer(data, dtype)[0])


_PLAIN: list[Any] = [
    (_float, "numpy.core.multiarray.scalar"),
    (_float, "numpy._core.multiarray.scalar"),
    (_float_type, "numpy.dtype"),
    type(np.dtype(np.float32)),
    type(np.dtype(np.float64)),
]

_STORAGES = ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Short", "Char", "Byte", "Bool")
_GLOBALS = frozenset(
    {
        "collections OrderedDict",
        "torch._utils _rebuild_tensor_v2",
        "torch._utils _rebuild_parameter",
        "numpy.core.multiarray scalar",
        "numpy._core.multiarray scalar",
        "numpy dtype",
        "_codecs encode",
        *(f"torch {kind}Storage" for kind in _STORAGES),
    }
)
"""What the pickle of a checkpoint names. torch's reader knows more, such as ``bytearray``, which makes gigabytes of one number."""
_LONGEST_PICKLE = 1 << 20
"""Bytes without the tensors' values; those of 3DGS and LangSplat have 3 000."""


def load_plain(path: str | Path) -> Any:
    """The content of a ``.pth`` file, on the CPU.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, or holds anything but tensors, numbers, texts and containers of these; nothing in it is run.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"checkpoint {path}: file must exist, got none")
    try:
        _require_modest(path)
        with torch.serialization.safe_globals(_PLAIN), warnings.catch_warnings():
            # Another protocol than torch's own is no news: what the reader does not know it refuses.
            warnings.filterwarnings("ignore", message="Detected pickle protocol")
            content = torch.load(path, map_location="cpu", weights_only=True)
        _require_stored(content, path.stat().st_size)
        return content
    except _UNREADABLE as error:
        reason = str(error).partition("\n")[0][:200]
        what = "must hold only tensors and plain values in torch's format"
        raise ValueError(
            f"checkpoint {path}: {what}, got {type(error).__name__}: {reason}"
        ) from None


def _require_modest(path: Path) -> None:
    """Do nothing if the pickles name nothing but what checkpoints do, and no part unfolds to more than it is long.

    Raises:
        ValueError: If it is otherwise.
    """
    if not zipfile.is_zipfile(path):  # before torch 1.6: five pickles, then the values
        with path.open("rb") as stream:
            pickles = io.BytesIO(stream.read(_LONGEST_PICKLE))
        for _ in range(5):
            _require_known(pickles)
        return
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("parts must not be compressed, as torch writes them")
        if sum(member.file_size for member in members) > path.stat().st_size:
            raise ValueError("parts must not be longer together than the file")
        for member in members:
            if member.filename.endswith(".pkl"):
                if member.file_size > _LONGEST_PICKLE:
                    raise ValueError(f"{member.filename} must be at most {_LONGEST_PICKLE} bytes")
                _require_known(io.BytesIO(archive.read(member)))


def _require_known(pickled: io.BytesIO) -> None:
    named, texts = set(), set()
    for operation, argument, _ in pickletools.genops(pickled):
        if operation.name == "GLOBAL":
            named.add(str(argument))
        elif operation.name in ("STACK_GLOBAL", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX"):
            raise ValueError(f"operation {operation.name} must not be in a checkpoint")
        elif isinstance(argument, str):
            texts.add(argument)
    if unknown := sorted(named - _GLOBALS):
        raise ValueError(f"names must be those of checkpoints, got {unknown[0][:80]}")
    if "_codecs encode" in named and any(map(_is_other_codec, texts)):
        raise ValueError("bytes must be written as latin1, got another encoding")


def _is_other_codec(text: str) -> bool:
    """Whether a text names an encoding, of which some take time with the square of what they are given."""
    try:
        return len(text) < 40 and codecs.lookup(text).name != "iso8859-1"
    except (LookupError, ValueError):
        return False


def _require_stored(content: Any, size: int) -> None:
    """Do nothing if every tensor is one of numbers that stand in the file; one number may stand for gigabytes of equal ones."""
    left, seen = [content], set()
    while left:
        value = left.pop()
        if isinstance(value, torch.Tensor):
            plain = value.layout is torch.strided and value.device.type == "cpu"
            if not plain or value.numel() * value.element_size() > size:
                raise ValueError(f"tensors must stand in the file, got {list(value.shape)}")
        elif isinstance(value, (list, tuple, dict)) and id(value) not in seen:
            seen.add(id(value))
            left += value.values() if isinstance(value, dict) else value


def save_plain(path: str | Path, content: Any) -> None:
    """Write a ``.pth`` file: complete, or the one before stays.

    Raises:
        OSError: If the file cannot be written.
    """
    stream = io.BytesIO()
    torch.save(content, stream)
    write_atomically(Path(path), stream.getvalue())
