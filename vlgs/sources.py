"""The sources of a package that somebody else wrote, found without importing it. Imports no torch."""

import hashlib
from functools import cache
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path


def is_importable(package: str) -> bool:
    """Whether there is a package of this name: in the current folder of `python -m`, on PYTHONPATH, or installed.

    Example:
        >>> is_importable("json"), is_importable("no_such_package")
        (True, False)
    """
    return _found(package) is not None


@cache
def sources_digest(package: str) -> str | None:
    """Hash of what is in the ``*.py`` of a package, or of a module that is one file; where a file lies and what it is called do not count.

    It is taken once, as a process imports a package once. What is compiled, and what the package imports from others, is not in it.

    Args:
        package: First part of a dotted name.

    Returns:
        None where there is no such package, or none with sources.

    Raises:
        OSError: If a file cannot be read.
    """
    found = _found(package)
    if found is None:
        return None
    files = {
        path.resolve()
        for folder in map(Path, found.submodule_search_locations or ())
        for path in folder.rglob("*.py")
        if path.is_file()
    }
    if found.submodule_search_locations is None and found.origin is not None:
        files = {path for path in [Path(found.origin)] if path.suffix == ".py"}
    every = sorted(hashlib.blake2b(path.read_bytes()).digest() for path in files)
    return hashlib.blake2b(b"".join(every), digest_size=8).hexdigest() if files else None


def _found(package: str) -> ModuleSpec | None:
    try:
        return find_spec(package) if package.isidentifier() else None
    except ValueError:  # of a module that says nothing of where it is from, as __main__
        return None
