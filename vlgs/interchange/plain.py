"""``torch.save`` files of tensors and plain values, read without running anything that they hold."""

import io
import pickle
import struct
import warnings
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
)
"""What torch's restricted reader raises on a file that it does not know or does not trust."""

# 3DGS stores the scene's extent as NumPy left it: a scalar of one of these two types, under the module names of NumPy 1 and 2.
_SCALAR = np.float64(0).__reduce__()[0]
_PLAIN: list[Any] = [
    (_SCALAR, "numpy.core.multiarray.scalar"),
    (_SCALAR, "numpy._core.multiarray.scalar"),
    np.dtype,
    type(np.dtype(np.float32)),
    type(np.dtype(np.float64)),
]


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
        with torch.serialization.safe_globals(_PLAIN), warnings.catch_warnings():
            # Another protocol than torch's own is no news: what the reader does not know it refuses.
            warnings.filterwarnings("ignore", message="Detected pickle protocol")
            return torch.load(path, map_location="cpu", weights_only=True)
    except _UNREADABLE as error:
        reason = str(error).partition("\n")[0][:200]
        what = "must hold only tensors and plain values in torch's format"
        raise ValueError(
            f"checkpoint {path}: {what}, got {type(error).__name__}: {reason}"
        ) from None


def save_plain(path: str | Path, content: Any) -> None:
    """Write a ``.pth`` file: complete, or the one before stays.

    Raises:
        OSError: If the file cannot be written.
    """
    stream = io.BytesIO()
    torch.save(content, stream)
    write_atomically(Path(path), stream.getvalue())
