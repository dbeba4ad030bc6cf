"""Writing files and folders so that a crash or a full disk never leaves half of one."""

import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

_TEMPORARY = re.compile(r"\..+\.\d+(-[0-9a-f]{8})?\.tmp")


def write_atomically(
    path: Path, data: bytes | Callable[[BinaryIO], object], durable: bool = True
) -> None:
    """Replace a file by `data`, or leave it as it was; a reader sees the old file or the whole new one.

    Args:
        path: The file; its folder must exist.
        data: Its content, or what writes it, where it is too large to be held.
        durable: Whether to wait until the disk has it, so that it survives a power cut too and not only a killed process.

    Raises:
        OSError: With the path and the cause; no temporary file stays behind.
    """
    sweep(path.parent)
    with _open_temporary(path) as file:
        temporary = Path(file.name)
        try:
            if callable(data):
                data(file)
            else:
                file.write(data)
            file.flush()
            if durable:
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException as error:
            with suppress(OSError):
                temporary.unlink()
            if (
                isinstance(error, OSError) and error.errno and not error.filename
            ):  # as writing's own
                raise OSError(error.errno, error.strerror or str(error), str(path)) from error
            raise
    if not durable:
        return
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_changed(path: Path, data: bytes) -> None:
    """`write_atomically`, unless the file has this content already, which saves waiting for the disk."""
    if not path.is_file() or path.read_bytes() != data:
        write_atomically(path, data)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A folder to fill, which becomes `path` when the context ends without an error: all of it, or nothing.

    Args:
        path: A folder that does not exist or is empty; the folders above it are made.

    Raises:
        OSError: If it cannot be made.
    """
    path = path.absolute()  # "." has no name
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep(path.parent)
    scratch, descriptor = _make_temporary(path)
    try:
        yield scratch
        scratch.replace(path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        os.close(descriptor)


def sweep(folder: Path) -> None:
    """Remove what killed processes left half-written in a folder.

    Who writes a temporary file or folder holds a lock on it, which dies with its process. Process numbers would not do: two
    containers that share a disk count their processes apart.
    """
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if _TEMPORARY.fullmatch(entry.name):
                _remove_if_dead(Path(entry.path))


def sweep_below(folder: Path) -> None:
    """`sweep` a folder and every folder in it."""
    for inner, _, _ in os.walk(folder):
        sweep(Path(inner))


def _temporary(path: Path) -> Path:
    """A new name beside `path`, as `sweep` knows it."""
    return path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")


def _make_temporary(path: Path) -> tuple[Path, int]:
    """A new folder beside `path`, and the descriptor that holds its lock."""
    while True:
        scratch = _temporary(path)
        scratch.mkdir()
        with suppress(FileNotFoundError):  # swept before it could be opened
            descriptor = os.open(scratch, os.O_RDONLY)
            with suppress(OSError):  # on a disk without locks nobody can sweep either
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            if scratch.is_dir():
                return scratch, descriptor
            os.close(descriptor)  # swept between the two calls


def _open_temporary(path: Path) -> BinaryIO:
    """A new file beside `path`, locked."""
    while True:
        file = _temporary(path).open("xb")
        with suppress(OSError):  # on a disk without locks nobody can sweep either
            fcntl.flock(file, fcntl.LOCK_EX)
        if os.fstat(file.fileno()).st_nlink:
            return file
        file.close()  # swept between the two calls


def _remove_if_dead(path: Path) -> None:
    with suppress(OSError):
        folder = path.is_dir() and not path.is_symlink()
        descriptor = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if folder:
                shutil.rmtree(path)
            else:
                path.unlink()
        finally:
            os.close(descriptor)
