"""A finished run of a second, for all that opens one."""

from pathlib import Path

import pytest
from tiny_runs import TINY, composed

from vlgs.opened import OpenedRun, open_run
from vlgs.run import run


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run; leave it as it is."""
    results = tmp_path_factory.mktemp("finished")
    config = composed(*TINY, "trainer=smoke", "pictures=false", f"results={results}")
    assert run(config) == 0
    return next((results / "runs").iterdir())


@pytest.fixture(scope="session")
def opened(finished: Path) -> OpenedRun:
    return open_run(finished)
