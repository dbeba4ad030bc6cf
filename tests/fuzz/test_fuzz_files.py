"""A few of the attacks of `python -m tests.fuzz files bombs`."""

from pathlib import Path

import pytest

from tests.fuzz import bombs
from tests.fuzz.__main__ import run_family
from tests.fuzz._corpus import write_corpus
from tests.fuzz.judge import run_attack

QUICK = [
    *("PLY: text, a billion vertices", "PLY: long comment", "ids: large shape"),
    *("vectors: nested header", "photograph: PNG that declares 60000", "npz: declares 3 GB"),
    *("images: count", "transforms: deep paths", "labels: 8 000 of one class"),
    *("labels: of 4 billion pixels", "pth: an array of one number", "safetensors: empty matrices"),
]


def test_mutated_files_are_read_or_refused_by_name():
    outcomes = run_family("files", seed=0, count=40)
    assert len(outcomes) == 40
    assert not [(o.name, o.said) for o in outcomes if not o.right]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bombs")
    write_corpus(folder / "corpus")
    return folder


@pytest.mark.parametrize("name", QUICK)
def test_bombs_do_not_go_off(corpus: Path, name: str):
    (bomb,) = (bomb for bomb in bombs.BOMBS if bomb[0] == name)
    outcome = run_attack(bombs.attack(corpus, bomb))
    assert outcome.right, outcome
