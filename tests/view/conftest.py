"""Finished runs of a second, for all that shows one."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_runs import TINY, composed

from vlgs.opened import open_run
from vlgs.run import run
from vlgs.view.eye import Eye, eye_of
from vlgs.view.shown import Shown

Show = Callable[[], Shown]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a run; leave it as it is."""
    results = tmp_path_factory.mktemp("viewed")
    config = composed(*TINY, "trainer=smoke", "pictures=false", f"results={results}")
    assert run(config) == 0
    return next((results / "runs").iterdir())


@pytest.fixture
def shown(folder: Path) -> Shown:
    return Shown(open_run(folder))


@pytest.fixture
def eye(shown: Shown) -> Eye:
    """That of a held-out photograph, in a window with other sides than its own."""
    return eye_of(shown.run.held_out()[0].camera, 80, 56)
