"""What options ask of each other is said by the options, and checked in one place for all commands."""

from pathlib import Path

import pytest
from slow import with_slow
from tiny_runs import composed

from tests.fuzz.commands import command
from vlgs.check import Report, start
from vlgs.demands import Demand, unmet
from vlgs.experiment import construct
from vlgs.indicator import PerLevel
from vlgs.known import options
from vlgs.training.levels import LEVEL_OPTIONS
from vlgs.training.sharing import Lifted, TwoModels

ALSO_MET = ("fixed", "identity")
"""Options that meet a demand too."""

DEMANDS = [
    demand
    for option in (PerLevel, TwoModels, Lifted)
    for demand in option.demands
    if demand.group
    != "gaussians"  # it has one option, whose values are asked: test_config_early.py
]

GATED = """
class Gated:
    def __call__(self, color, feature):
        return color, feature

class Apart(Gated):
    separable = True
"""


LIFTED = [demand for demand in DEMANDS if demand in Lifted.demands]


@pytest.mark.parametrize("demand", with_slow(DEMANDS, LIFTED[1:]), ids=str)
def test_a_demand_names_options_that_exist_and_one_that_meets_it(demand: Demand):
    group, _, name = demand.asker.partition("=")
    assert name in options(group)
    known = list(LEVEL_OPTIONS) if demand.group == "levels" else options(demand.group)
    met = {"fusion": "none", "indicator": "opacity", "levels": "joint", "head": "autoencoder"}
    fitting = {other: f"{other}={option}" for other, option in met.items() if other != group}
    construct(composed(demand.asker, *fitting.values()))
    wrong = next(name for name in reversed(known) if name not in (met[demand.group], *ALSO_MET))
    fitting[demand.group] = f"{demand.group}={wrong}"
    said = f"config: {demand.group} must be .*{met[demand.group]}.* with {demand.asker}.*, got {wrong}$"
    with pytest.raises(ValueError, match=said):
        construct(composed(demand.asker, *fitting.values()))


def test_check_says_what_run_says_beside_the_faults_of_the_scene():
    config, fault = composed("sharing=none"), Report((), ("scene",))
    with pytest.raises(ValueError, match="fusion must be none with sharing=none") as raised:
        construct(config)
    report = start(config, fault)
    assert [str(fault) for fault in report.faults] == [str(raised.value)]
    assert report.summary == ("scene",)


def test_a_part_of_a_plugin_is_refused_until_it_says_that_it_fits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "my_parts.py").write_text(GATED)
    monkeypatch.syspath_prepend(str(tmp_path))
    apart = ("sharing=none", "fusion=none")
    with pytest.raises(ValueError, match=r"fusion must be none with .*, got my_parts\.Gated"):
        construct(composed(*apart, "fusion._target_=my_parts.Gated"))
    construct(composed(*apart, "fusion._target_=my_parts.Apart"))


def test_what_says_nothing_has_no_property():
    asking = TwoModels()
    assert list(unmet({"sharing": asking, "fusion": object()})) == list(TwoModels.demands)
    assert not list(unmet({"fusion": object()}))


def test_the_command_says_it_too(tmp_path: Path):
    """Inside of Hydra's own program, which allows no second one."""
    done = command("run", ["sharing=none", f"results={tmp_path}"])
    assert done.status == 1
    said = "config: fusion must be none with sharing=none, as a Gaussian then carries colour or language but not both, got self"
    assert done.error == said
    assert done.text.strip() == f"error: {said}"
