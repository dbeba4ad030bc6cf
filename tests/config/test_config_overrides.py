"""Text given on a command line arrives as it was given, whatever Hydra's grammar and OmegaConf make of its characters."""

import random

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from vlgs.config import literal_override, override_value, quote_override

HOSTILE = (
    "/x/Ünï dir", "a,b", "[a]/x", "a=b", "{a: b}", "f(x)", "it's", 'a"b', "a\\", "a\\'b", " a ", "3", "nUll", "True", "1e5", "",
    "a#b", "~/x", "${x}", "\\${x}", "\\\\${oc.env:HOME}", "$${x}", "日本", "a\tb\nc", "'", "<x>", "`x`", "\u202e", "..",
)  # fmt: skip


def arrived(argument: str) -> str:
    """What the configuration holds under the key ``results`` after Hydra has read the argument."""
    return OmegaConf.create({"results": override_value(argument)}).results


def test_quoted_text_arrives_as_it_is():
    rng = random.Random(0)
    alphabet = "ab'\\${}[],= ()\"ü.:"
    mixed = ["".join(rng.choices(alphabet, k=rng.randint(1, 8))) for _ in range(300)]
    wrong = [
        text for text in (*HOSTILE, *mixed) if arrived(quote_override("results", text)) != text
    ]
    assert not wrong


@pytest.mark.parametrize(
    "argument",
    ["seed=3", "a=[1, 2]", "data.root='/x y'", "results=a b", "~key", "key=null", "key="],
)
def test_what_hydra_reads_is_left_as_given(argument: str):
    assert literal_override(argument) == argument


@pytest.mark.parametrize("text", ["/x/a, b", "/x/Ö", " x", "a(b)", "a=b"])
def test_what_hydra_does_not_read_is_taken_as_text(text: str):
    read = OverridesParser.create().parse_override(literal_override(f"data.root={text}"))
    assert (read.key_or_group, read.value()) == ("data.root", text)
