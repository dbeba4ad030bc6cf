"""Writing files so that a crash or a full disk never leaves half of one."""

import os
from contextlib import suppress
from pathlib import Path


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file by `data`, or leave it as it was.

    Raises:
        OSError: With the path and the cause; no temporary file stays behind.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        with suppress(OSError):
            temporary.unlink()
        raise
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_changed(path: Path, data: bytes) -> None:
    """`write_atomically`, unless the file holds just that: a file that stays need not wait for the disk."""
    if not path.is_file() or path.read_bytes() != data:
        write_atomically(path, data)
