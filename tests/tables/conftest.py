"""A small table, and rows that are composed once for all tests."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from tables_fakes import TABLE

from vlgs.tables import benchmark
from vlgs.tables.registry import Table, load_table


@pytest.fixture
def table(tmp_path: Path) -> Table:
    path = tmp_path / "tiny.yaml"
    path.write_text(TABLE)
    return load_table(path)


@pytest.fixture(scope="session", autouse=True)
def composed_once() -> Iterator[None]:
    """The tests ask for a few dozen rows hundreds of times, and Hydra takes a tenth of a second for each."""
    compose = benchmark._compose
    known = cache(lambda overrides: compose(list(overrides)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "_compose", lambda overrides: known(tuple(overrides)))
        yield
