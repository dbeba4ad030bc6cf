"""Names of files on the command line reach the configuration as typed, and printed commands give them back."""

import random
import shlex
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.fuzz.commands import command
from vlgs.arguments import command_line, quote_places

ODD = (
    "/x/Ünï (1), [b]=c/scene", "a,b", "[a]", "{a: b}", "f(x)", "it's", 'a"b', "a\\", "a\\ b", " a ", "3", "1e5", "nan", "true",
    "#1", "a~b", "-lead", "$HOME", "日本", "😀", "a\tb\nc", "a:b", "`x`", "100%", "a&b;c|d", "choice(a,b)", "a!b", "*?",
)  # fmt: skip


def arrived(argument: str) -> object:
    return OverridesParser.create().parse_override(argument).value()


def test_the_name_of_a_folder_is_taken_as_it_is():
    rng = random.Random(0)
    mixed = ["".join(rng.choices("ab'\\[],= ()\"ü.:~-", k=rng.randint(2, 8))) for _ in range(200)]
    # What is in quotes from end to end is quoted already; a leading ~/ is the home folder.
    names = [n for n in (*ODD, *mixed) if n[0] not in "'\"" and not n.startswith("~/")]
    wrong = [n for n in names if arrived(quote_places([f"data.root={n}"])[0]) != n]
    assert not wrong


def test_a_printed_command_is_the_one_that_was_typed():
    for name in ODD:
        (quoted,) = quote_places([f"results={name}"])
        assert shlex.split(command_line("vlgs.run", [quoted]))[3:] == [f"results={name}"]


@pytest.mark.parametrize(
    "argument",
    [
        "fusion=self", "data.test=[a,b]", "plugins=[x]", "trainer.init=a(b", "fusion.init=zero",
        "data.root='/x (1)'", 'data.root="/x (1)"', "data.labels=null", "data.root=", "results=/x/${seed}",
        "--multirun", "data.root=/plain/a-b_c.d",
    ],
)  # fmt: skip
def test_what_is_no_place_or_needs_no_quotes_is_left(argument: str):
    assert quote_places([argument]) == [argument]


def test_an_interpolation_beside_odd_characters_keeps_its_meaning():
    assert quote_places(["results=/Ü/${seed}"]) == ["results='/Ü/${seed}'"]


@pytest.mark.parametrize("name", ["/x/a${", "/x/\udcff"])
def test_a_name_that_no_configuration_carries_is_refused(name: str):
    with pytest.raises(ValueError, match="command: names of files must be UTF-8 without"):
        quote_places([f"results={name}"])


def test_a_home_folder_is_found(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", "/home/Jürgen")
    assert quote_places(["data.root=~/a b"]) == ["data.root='/home/Jürgen/a b'"]


def test_commas_separate_values_of_a_sweep():
    given = ["-m", "data.root=/a,/b", "data.labels=/Ü (1),/b", "results=[1]", "seed=0,1"]
    want = ["-m", "data.root=/a,/b", "data.labels='/Ü (1)',/b", "results='[1]'", "seed=0,1"]
    assert quote_places(given) == want


def test_an_odd_folder_that_is_not_there_is_named(tmp_path: Path):
    root = tmp_path / "Ünï (1), [b]=c"
    done = command("run", ["data=colmap", f"data.root={root}", f"results={tmp_path}/results"])
    assert done.status == 1
    assert f"no such folder as {root}" in done.error
    assert "Traceback" not in done.text
