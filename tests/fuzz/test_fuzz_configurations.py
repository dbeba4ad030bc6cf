"""A sample of `tests.fuzz.configurations`: check and run refuse the same in the same words, at once, and leave nothing."""

from pathlib import Path

import pytest
from slow import with_slow

from tests.fuzz.commands import TINY, both
from vlgs.command import check_command

REFUSED = {
    "trainer.iterations=0": "iterations must be 1 to 1e+09, got 0",
    "trainer.learning_rates.means=-1.0": "learning_rates: means must be 0 to 1, got -1.0",
    "trainer.learning_rates.means=1e-320": "learning_rates: means must be 0 or 1e-30 to 1",
    "seed=18446744073709551616": "config: seed must be a whole number",
    "threads=100000": "config: threads must be 1 to 256, got 100000",
    "blend.alpha=nan": "blend: alpha must be a finite number, got nan",
    "gaussians.densify=null": "gaussians: densify must be",
    "query.negatives=[unheard]": "query: the text encoder must know the negatives unheard",
    "raster.alpha_max=1.0": "RasterConfig: alpha_max must be below 1",
}
AT_ONCE = {
    "trainr=photos": "trainr must be a key, got one that is not there; did you mean trainer?",
    "+trainr=photos": "trainr must be a key that is read, got one that nothing reads; did you mean trainer?",
    "+trainer.iteration=100": "did you mean trainer.iterations?",
    "trainer=phots": "trainer must be one of .* did you mean photos or fast_photos?",
    "trainer=base": "trainer must be one of",
    "data.rot=": "did you mean data.root?",
    "data.root=x": "data=colmap or .* has it",
    "~fusion": "which takes fusion away",
    "+seed=1": "seed must be given without",
    "+trainer=photos": "trainer must be given without +",
    "trainer=smoke +trainer=photos": "trainer must be given without +",
    "trainer@foo=photos": "options must be given as trainer=OPTION",
    f"seed={'9' * 5000}": "command: seed must be a value that can be read",
    "data.root=a b[": "arguments must be KEY=VALUE",
    "fusion=null": "fusion must be one of",
    "-m fusion=none,mpl": "did you mean mlp?",
    "-m +foo=1,2": "foo must be a key that is read",
}


@pytest.mark.parametrize("line", AT_ONCE)
def test_a_mistake_is_told_before_anything_is_imported(line: str):
    arguments = [line] if line.startswith("data.root") else line.split()
    with pytest.raises(ValueError, match=AT_ONCE[line].replace("?", r"\?").replace("+", r"\+")):
        check_command(arguments)


OF_A_KIND = [
    line
    for line in REFUSED
    if line.startswith(("trainer.learning_rates", "threads", "blend", "raster"))
]


@pytest.mark.parametrize("line", with_slow(REFUSED, OF_A_KIND))
def test_check_and_run_refuse_alike(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    checked, ran = both([*TINY, line], tmp_path / "results")
    assert REFUSED[line] in ran.error
    assert checked.status == ran.status == 1
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    "place", with_slow(["file", "file/below", "gone", "round", "n" * 300], ["file", "round"])
)
def test_results_that_cannot_be_kept_are_refused_by_check_and_run(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "gone").symlink_to("nowhere/at/all")
    (tmp_path / "round").symlink_to("round")
    _, ran = both([*TINY, f"results={place}"], tmp_path / "results")
    assert "config: results must be a folder that is there or can be made, got" in ran.error
