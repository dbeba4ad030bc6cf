"""A sample of `tests.fuzz.targets`: nothing dangerous is constructed or imported, everything honest is taken."""

from pathlib import Path

import pytest

from tests.fuzz import targets
from vlgs.command import check_command

SAMPLE = [
    ("--config-dir=strange/bomb", "fusion=evil"),
    ("--config-dir=strange/latin", "fusion=evil"),
    *((f"fusion._target_={target}",) for target in targets.DANGEROUS[::7]),
    *((f"{place}._target_=torch.load",) for place in targets.PLACES[::6]),
    *((f"fusion._target_={name}",) for name in targets.NO_NAMES[::4]),
    *targets.SMUGGLED[::4],
]


@pytest.fixture
def strangers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    targets.write_strangers(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("EVIL", "os.system")
    return tmp_path


@pytest.mark.parametrize("arguments", SAMPLE, ids=" ".join)
def test_what_could_run_code_is_refused_before_it_does(arguments: tuple[str, ...], strangers: Path):
    with pytest.raises(ValueError, match=r"config|command|strange"):
        check_command(arguments)
    assert not (strangers / targets.CANARY).exists()


@pytest.mark.parametrize("arguments", targets.HONEST[:7], ids=" ".join)
def test_what_is_honest_is_taken_unless_something_foreign_stands_beside_it(
    arguments: tuple[str, ...], strangers: Path
):
    check_command(arguments)
    with pytest.raises(ValueError, match=r"query\._target_ must be one of vlgs\.queries"):
        check_command((*arguments, "query._target_=evil_lab.strike"))
    assert not (strangers / targets.CANARY).exists()
