"""Something else where a file belongs: a pipe that nobody writes to, a device without end, a folder, a link that leads nowhere."""

import os
import shutil
import socket
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tests.fuzz._corpus import Honest, write_corpus
from tests.fuzz.judge import Attack
from vlgs.data.lens import import_pycolmap

PATIENCE = 60
"""Seconds by the clock: what waits for a pipe or reads a device to its end does so without using the processor."""


def _socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # the address of a socket may have a hundred letters
    try:
        with socket.socket(socket.AF_UNIX) as opened:
            opened.bind(path.name)
    finally:
        os.chdir(here)


def _full_folder(path: Path) -> None:
    path.mkdir()
    (path / "file").touch()


KINDS: dict[str, Callable[[Path], None]] = {
    "a pipe": os.mkfifo,
    "a device without end": lambda path: path.symlink_to("/dev/zero"),
    "a device of nothing": lambda path: path.symlink_to("/dev/null"),
    "a socket": _socket,
    "a folder": Path.mkdir,
    "a folder of files": _full_folder,
    "a link to nothing": lambda path: path.symlink_to("nowhere"),
    "a link to itself": lambda path: path.symlink_to(path.name),
}


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """Every kind in the place of every file of the corpus; the list is fixed."""
    del seed, count
    import_pycolmap()  # once, and not in every child
    corpus = write_corpus(folder / "corpus")
    for honest in corpus:
        for kind, make in KINDS.items():
            said = honest.path.name if honest.names_itself else str(folder / "attack")
            call = partial(_attack, folder, honest, make)
            yield Attack(f"{honest.path}: {kind}", call, must_say=said, endless=PATIENCE)


def _attack(folder: Path, honest: Honest, make: Callable[[Path], None]) -> None:
    unit = folder / "attack" / honest.unit
    shutil.rmtree(folder / "attack", ignore_errors=True)
    shutil.copytree(folder / "corpus" / honest.unit, unit)
    path = unit / honest.path.relative_to(honest.unit)
    path.unlink()
    make(path)
    honest.read(unit)
