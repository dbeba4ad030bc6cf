"""A sample of `tests.fuzz.scenes`: what check says of an odd scene is what run does with it."""

from pathlib import Path

import pytest
from slow import with_slow

from tests.fuzz.commands import both
from tests.fuzz.scenes import OPTIONS, cases, write

SAMPLE = (
    "one point",
    "vocabulary lacks a category",
    "vocabulary without negatives",
    "one photograph is larger",
    "1 x 1",
)


CASES = [case for case in cases() if case.name in SAMPLE]


@pytest.mark.parametrize(
    "case",
    with_slow(CASES, [case for case in CASES if "negatives" in case.name]),
    ids=lambda case: case.name,
)
def test_check_and_run_agree(case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "scene", case.scene)
    place = f"data.root={tmp_path / 'scene'}"
    checked, ran = both([*OPTIONS, *case.options, place], tmp_path / "results")
    assert case.says in checked.text
    assert case.refused is None or (ran.status == 1) == case.refused
