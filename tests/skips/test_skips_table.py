"""The table of skips is what the configuration has and what conf/README.md says."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf
from tiny_runs import composed

from vlgs.config import instantiate
from vlgs.skips import SKIPS, Skip, markdown_table, named, turn

README = Path(__file__).parents[2] / "conf/README.md"
SWITCHES = [skip for skip in SKIPS if skip.switchable]


def test_names_are_unique_and_every_row_says_what_it_costs():
    assert len({skip.name for skip in SKIPS}) == len(SKIPS)
    for skip in SKIPS:
        assert skip.what.endswith(".")
        assert skip.bound in ("same bits", "<= 1e-6") or skip.kind == "bounded"
        assert bool(skip.bound) == (skip.kind != "statistical")


@pytest.mark.parametrize("skip", SWITCHES, ids=lambda skip: skip.name)
def test_a_switch_is_in_the_configuration_with_valid_values(skip: Skip):
    assert OmegaConf.select(composed(), skip.setting) == getattr(skip, skip.default)
    for on in (True, False):
        config = composed(skip.override(on))
        assert OmegaConf.select(config, skip.setting) == (skip.on if on else skip.off)
        instantiate(config[skip.setting.partition(".")[0]])


def test_what_has_no_switch_cannot_be_turned():
    with pytest.raises(ValueError, match="skip culling: must have a switch to be turned, got none"):
        named("culling").override(on=True)


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match=r"skips: name must be one of .*, got 'cull'"):
        named("cull")


def test_two_skips_of_one_key_do_not_override_each_other():
    key = "trainer.skip.blend_weight"
    with pytest.raises(
        ValueError,
        match=rf"skips: {key} must have one value, got {key}=0.0 and {key}=0.5 of blend_small",
    ):
        turn(["blend_zero", "tile_test", "blend_small"], on=True)
    assert turn(["blend_zero", "blend_zero"], on=False) == (f"{key}=-1.0",)


def test_readme_shows_the_table():
    assert markdown_table() in README.read_text()
