"""`conf` is the schema: it mirrors the constructors, and `--help` prints it."""

import functools
import inspect
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import get_object
from omegaconf import open_dict

from vlgs.command import check_command
from vlgs.config import check_config, check_targets
from vlgs.known import CONF, contents, groups, nodes, options, place
from vlgs.manual import describe

FREE = {"vlgs.data.colmap.load_scene", "vlgs.fusion.none.NoFusion"}
"""These take what their files say, or anything."""

SINCE_THE_SCENE = {"vocabulary"}
"""Given by the run, not by the configuration."""


def whole(path: Path) -> dict[str, Any]:
    """An option with what it says itself and what the option says that it begins with."""
    content = contents(path)
    above = [name for name in content.get("defaults", []) if isinstance(name, str)]
    files = [path.with_name(f"{name}.yaml") for name in above if name.isidentifier()]
    first = {k: v for file in files if file.is_file() for k, v in whole(file).items()}
    return {key: value for key, value in (first | content).items() if key != "defaults"}


@functools.cache
def constructed() -> dict[str, set[str]]:
    """Target -> all keys that any file of conf gives it."""
    found: dict[str, set[str]] = {}
    for path in CONF.rglob("*.yaml"):
        for _, node in nodes(whole(path), place(path)):
            target = node.get("_target_")
            if isinstance(target, str) and target.startswith("vlgs."):
                found.setdefault(target, set()).update(map(str, node))
    return found


CHOSEN = {"vlgs.features.tiles.TilePyramid": {"encoder"}}
"""Target -> arguments that are options of a group of their own in every file."""


@pytest.mark.parametrize("target", sorted(set(constructed()) - FREE))
def test_conf_mirrors_constructors(target: str):
    given = constructed()[target] - {"_target_", "_partial_"} | CHOSEN.get(target, set())
    taken = set(inspect.signature(get_object(target)).parameters) - SINCE_THE_SCENE
    assert given <= taken
    if target not in ("vlgs.training.settings.TrainerConfig", "vlgs.view_blend.NoBlend"):
        assert given == taken


@pytest.mark.parametrize("group", sorted(groups()))
def test_help_lists_the_keys_of_every_option(group: str):
    for option in options(group):
        text = describe(group, option)
        for key in contents(CONF / group / f"{option}.yaml"):
            assert f"{key}" in text or key in ("_target_", "_partial_", "defaults")


def test_help_of_an_option_has_defaults_and_comments(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        check_command(["--help", "data=lerf_ovs"])
    assert not stop.value.code
    out = capsys.readouterr().out
    assert "data.resize=1.0" in out  # of colmap, which it is made from
    assert "data.scene=???" in out
    assert "figurines, ramen, teatime, waldo_kitchen" in out
    assert "output size as a fraction of the image file's" in out


FEATURES = [
    ("features", name) for name in options("features") if name != "own"
]  # whose class is to be given
FEATURES += [(group, name) for group in ("features/encoder", "features/segmenter") for name in options(group)]  # fmt: skip


@pytest.mark.parametrize(("group", "option"), FEATURES)
def test_each_way_to_make_features_has_keys_that_are_read(group: str, option: str):
    given = ["data.root=scene", f"{group}={option}"]
    if option == "maps":
        given.append("features.extractor.encoder.folder=maps")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("features", overrides=given)
    check_targets(config, "features")
    with open_dict(config):
        config.features.extractor.unheard = 1
    with pytest.raises(
        ValueError, match=r"features\.extractor\.unheard must be a key that is read"
    ):
        check_targets(config, "features")


@pytest.mark.parametrize(
    ("given", "missing"),
    [
        (["data=lerf_ovs"], r"data\.root"),
        (["data=mipnerf360"], r"data\.root"),
        (["data=mipnerf360", "data.root=scenes"], r"data\.scene"),
    ],
)
def test_what_other_values_are_made_of_must_be_given(given: list[str], missing: str):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=given)
    with pytest.raises(ValueError, match=rf"^config: {missing} must be given, as {missing}=VALUE;"):
        check_config(config)


def test_an_option_of_ones_own_has_its_keys_in_its_own_file():
    assert describe("fusion", "gated").splitlines()[0] == "fusion=gated"
