"""A small table."""

from pathlib import Path

import pytest
from tables_fakes import TABLE

from vlgs.tables.registry import Table, load_table


@pytest.fixture
def table(tmp_path: Path) -> Table:
    path = tmp_path / "tiny.yaml"
    path.write_text(TABLE)
    return load_table(path)
