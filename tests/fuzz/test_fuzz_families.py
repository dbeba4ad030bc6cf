"""A sample of the attacks of `python -m tests.fuzz`, in children of a process that computes nothing: one that has computed with threads must not be forked."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.fuzz._table import FamilyRow, begun, write_row
from tests.fuzz.judge import AttackOutcome
from vlgs.ablate import warm
from vlgs.ablate.warm import WarmParent

FILES = ("--count", "14")
LARGER = {
    "files": ("--count", "40"),
    "bombs": ("--every", "12"),
    "paths": ("--count", "42"),
    "places": ("--every", "16"),
    "text": ("--every", "13", "--count", "0"),
    "results": ("--every", "13", "--count", "0"),
    "scene_files": ("--count", "30"),
}


@pytest.fixture(scope="module")
def parent() -> Iterator[WarmParent]:
    """One process that has imported what every family needs; each sample is met in a child of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(Path(__file__).parents[2])
        patch.setattr(warm, "MODULE", "tests.fuzz")
        patch.setattr(warm, "SHARED", [f"tests.fuzz.{family}" for family in LARGER])
        parent = WarmParent()
    yield parent
    parent.close()


def meet(parent: WarmParent, family: str, options: tuple[str, ...], least: int, log: Path) -> None:
    log.touch()
    run = parent.start([family, *options], log)
    assert run is not None
    run.wait(900.0)
    said = log.read_text()
    assert run.returncode == 0, said
    tried, right = map(int, re.findall(r"tried +(\d+)  right +(\d+)", said)[0])
    assert tried == right > least


# Files are what strangers hand over most; every further family starts anew, for seconds however small its sample is.
def test_a_sample_of_the_attacks_is_met_rightly(parent: WarmParent, tmp_path: Path):
    meet(parent, "files", FILES, 4, tmp_path / "log")


@pytest.mark.slow
@pytest.mark.parametrize("family", LARGER)
def test_a_larger_sample_of_the_attacks_is_met_rightly(
    family: str, parent: WarmParent, tmp_path: Path
):
    meet(parent, family, LARGER[family], 10, tmp_path / "log")


def test_a_family_is_gone_on_with_on_the_same_code_alone(tmp_path: Path):
    fresh, path = FamilyRow("files", 100, 0, "abc"), tmp_path / "attacks.csv"
    assert begun(path, fresh) == fresh
    outcome = AttackOutcome("cut", True, "", seconds=0.25, megabytes=3.0)
    write_row(path, fresh.plus(outcome, wall=1.0))
    write_row(path, FamilyRow("bombs", 100, 0, "abc", tried=2, right=1))
    assert begun(path, fresh) == fresh.plus(outcome, wall=1.0)
    for other in (replace(fresh, commit="abd"), replace(fresh, count=5), replace(fresh, seed=1)):
        assert begun(path, other) == other
    bombs = FamilyRow("bombs", 100, 0, "abc")
    assert begun(path, bombs) == bombs  # what went wrong is tried again
