"""Whether a recorded result is still that of this code, where the tests of a folder belong to the code."""

from pathlib import Path

from vlgs.report.provenance import commit, same_code


def commit_with(folder: Path) -> str | None:
    """Commit of the checkout, with ``+dirty`` if the package, its configuration, or this folder of tests has changed."""
    package, tests = commit(), commit(folder)
    return tests if package is None or "+dirty" not in package else package


def same_code_with(folder: Path, one: str | None, other: str | None) -> bool:
    """Whether two such commits mean the same package, configuration and folder of tests."""
    return same_code(one, other) and same_code(one, other, folder)
