"""A method is a YAML file: an overlay of the axes, and a list of stages."""

from dataclasses import asdict
from pathlib import Path

import pytest
from omegaconf import DictConfig
from tiny_runs import TINY, composed

from vlgs.config import check_config
from vlgs.experiment import construct
from vlgs.fields.hash_grid import GridConfig
from vlgs.fields.language_field import LanguageConfig
from vlgs.identity import identity
from vlgs.known import option, options
from vlgs.run import run
from vlgs.runs import RunFolder
from vlgs.training.checkpoint import load_checkpoint
from vlgs.training.hash_features import TrainHashFeatures
from vlgs.training.stages import Lift, Train, TrainColor

FEATURES = """# @package _global_
defaults:
  - override /fusion: none
  - override /indicator: opacity
  - override /blend: none
levels: joint
stages:
  - {_target_: vlgs.training.stages.TrainColor, name: geometry, kept: false}
  - _target_: vlgs.training.stages.Train
    start: geometry
    freeze: [means, quats, log_scales, sh0, shN, opacity_logits]
"""
LIFT = (
    FEATURES.partition("  - _target_")[0]
    + "  - {_target_: vlgs.training.stages.Lift, start: geometry}\n"
)


@pytest.fixture
def chosen(tmp_path: Path):
    """Composes a command line of somebody with two methods of their own."""
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "features.yaml").write_text(FEATURES)
    (tmp_path / "method" / "lifted.yaml").write_text(LIFT)
    path = f"hydra.searchpath=[file://{tmp_path}]"

    def compose(*overrides: str) -> DictConfig:
        own = {"method=features", "method=lifted"} & {*overrides}
        return composed(*([path] if own else []), *TINY, *overrides)

    return compose


def test_a_method_is_an_overlay_that_the_command_line_overrides(chosen):
    config: DictConfig = chosen("method=features")
    check_config(config)
    experiment = construct(config)
    freeze = config.stages[1].freeze
    stages = [TrainColor("geometry", kept=False), Train(start="geometry", freeze=freeze)]
    assert experiment.method is not None
    assert experiment.method.listed == stages
    assert experiment.level_models == "joint"
    assert config.fusion._target_.endswith("NoFusion")
    given = chosen("method=features", "fusion=mlp", "levels=single")
    assert given.fusion._target_.endswith("MLP")
    assert given.levels == "single"
    assert construct(chosen("method=vlgs")).method is None


def test_what_a_method_trains_moves_the_id_and_the_name_of_a_class_does_not(chosen):
    axes = ("fusion=none", "indicator=opacity", "blend=none", "levels=joint")
    plain, features, lift = (
        identity(chosen(*overrides)).recipe
        for overrides in (axes, ("method=features",), ("method=lifted",))
    )
    assert len({plain, features, lift}) == 3
    kinds = [
        f"stages=[{{_target_: vlgs.training.stages.{kind}, start: x}}]"
        for kind in ("Train", "Lift")
    ]
    assert len({identity(chosen(kind)).recipe for kind in kinds}) == 2
    assert option("stages.0", "vlgs.training.stages.Train") == "train"


@pytest.mark.usefixtures("unchecked")
def test_a_method_runs(chosen, tmp_path: Path):
    config = chosen(
        "method=features", "trainer=smoke", "trainer.iterations=6", f"results={tmp_path}"
    )
    config.pictures = False
    assert run(config) == 0
    (path,) = (tmp_path / "runs").iterdir()
    for name in ("", "geometry"):
        checkpoint = load_checkpoint(RunFolder(path / name).checkpoint)
        assert checkpoint is not None
        assert checkpoint.step == 6
    assert (path / "point_cloud.ply").is_file()
    assert not (path / "geometry" / "point_cloud.ply").exists()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["method=features", "sharing=none"], "sharing must be pos or pos_cov with stages of a method, as .*, got none"),
        (["method=lifted", "fusion=self"], "fusion must be none with language that is lifted, as nothing trains it"),
        (["method=gs3d", "fusion=self"], "fusion must be none with a method of colour alone, as there is no language, got self"),
        (["method=gs3d", "indicator=learned"], "indicator must be fixed or opacity with a method of colour alone"),
        (["method=langsplat", "blend=beta"], "loss must be default with a blended view, as no other .*, got langsplat$"),
        (["method=langsplat", "indicator=learned"], "indicator must be fixed or opacity with a stage that freezes indicator_logits, as .*, got learned$"),
        (["method=goi", "head=autoencoder"], "head must be lookup with loss.lookup, as it learns the rows of a table, got autoencoder"),
        (["method=lerf", "augment=offline"], "augment must be none with a radiance field, as there are no Gaussians to render .*, got offline$"),
        (["method=opennerf", "levels=separate"], "levels must be single or joint with a radiance field, as there is one field .*, got separate$"),
        (["stages=[3]"], "config: stages must be a list of stages, got"),
        (["stages=[{_target_: vlgs.training.stages.Train, start: shape}]"], r"earlier stage \(none\), got 'shape'"),
        (["stages=[{_target_: vlgs.training.stages.Train, name: ../up}]"], r"name must be of small letters.*got '../up'"),
        (["stages=[{_target_: vlgs.training.stages.Train, name: renders}]"], r"none of augment, .*got 'renders'"),
        (["stages=[]"], "stages: there must be at least one, got none"),
        (["stages=[{_target_: vlgs.run.run}]"], "stages.0._target_ must be one of"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("unchecked")
def test_what_no_method_can_be_is_refused(chosen, overrides: list[str], message: str):
    config = chosen(*overrides)

    def refuse() -> None:
        check_config(config)
        construct(config)

    with pytest.raises(ValueError, match=message):
        refuse()


GRID = "_target_: vlgs.fields.hash_grid.GridConfig"
NUMBERS = "features: 2, coarsest: 4, finest: 16, log2_table: 10"


def _with_grids(grids: str) -> DictConfig:
    """FMGS with these hash grids."""
    network = (
        f"{{_target_: vlgs.fields.language_field.LanguageConfig, scaled: false, grids: {grids}}}"
    )
    return composed("method=fmgs", f"+stages.1.network={network}")


def test_a_list_of_parts_is_constructed_part_by_part():
    config = _with_grids(f"[{{{GRID}, levels: 4, {NUMBERS}}}, {{{GRID}, levels: 2, {NUMBERS}}}]")
    check_config(config)
    method = construct(config).method
    assert method is not None
    stage = method.listed[1]
    assert isinstance(stage, TrainHashFeatures)
    grids = (GridConfig(4, 2, 4, 16, 10), GridConfig(2, 2, 4, 16, 10))
    assert stage.network == LanguageConfig(grids, scaled=False)
    assert asdict(stage.network)["grids"] == tuple(map(asdict, grids))  # as it is saved


@pytest.mark.parametrize(
    ("grids", "message"),
    [
        (f"[{{{GRID}, level: 4, {NUMBERS}}}]", r"grids.0.level must be a key that is read, .* did you mean stages.1.network.grids.0.levels\?"),
        (f"[{{{GRID}, levels: 4, {NUMBERS}}}, {{levels: 4}}]", r"grids.1.levels must be a key that is read, .*; stages.1.network.grids.1._target_ must say whose it is"),
        (f"[{{{GRID}, {NUMBERS}}}]", "grids: arguments must be those of GridConfig, .*missing a required argument: 'levels'"),
        (f"[{{{GRID}, levels: 4.5, {NUMBERS}}}]", "grids: levels must be a whole number, got 4.5"),
        (f"[{{{GRID}, levels: 4, {NUMBERS}}}, 3]", r"network: grids must be a list, each the settings of a GridConfig, got \[3\]"),
        ("[{_target_: vlgs.fields.language_field.LanguageConfig}]", r"grids.0._target_ must be one of vlgs.fields.hash_grid.GridConfig, got"),
        ("[{_target_: my_lab.Grid}]", r"grids.0._target_ must be one of .*, got 'my_lab.Grid'; if you trust it, .*plugins=\[my_lab\]"),
        ("[{_target_: os.system, command: ls}]", r"grids.0._target_ must be one of vlgs.fields.hash_grid.GridConfig, got 'os.system'$"),
    ],
)  # fmt: skip
def test_a_list_of_parts_with_something_else_is_refused(grids: str, message: str):
    config = _with_grids(grids)

    def refuse() -> None:
        check_config(config)
        construct(config)

    with pytest.raises(ValueError, match=message):
        refuse()


def test_keys_of_a_part_that_is_not_there_are_told_so():
    config = composed("method=fmgs", f"+stages.1.network.grids=[{{{GRID}, levels: 4, {NUMBERS}}}]")
    with pytest.raises(
        ValueError, match=r"nothing reads; stages.1.network._target_ must say whose it is"
    ):
        check_config(config)


RELEASED = [
    name for name in options("method") if name != "best"
]  # which is ours, with rates of its own


@pytest.mark.parametrize("method", RELEASED)
@pytest.mark.usefixtures("unchecked")
def test_the_budget_of_the_released_programs_goes_with_every_method(method: str):
    config = composed(f"method={method}", "trainer=released")
    check_config(config)
    trainer, densify = (construct(config).parts.trainer, config.gaussians.densify)
    assert trainer.iterations == 15000
    assert densify.grad_threshold == 2e-4
    rates, released = config.trainer.learning_rates, composed("trainer=released").trainer
    own = {"features"}  # a method may say how fast its codes learn
    own |= {"shN"} if method == "best" else set()  # which is none of the released programs
    assert {k: v for k, v in rates.items() if k not in own} == {
        k: v for k, v in released.learning_rates.items() if k not in own
    }


def test_two_stages_of_one_name_are_refused():
    from vlgs.training.stages import Method

    with pytest.raises(ValueError, match="name must differ from those before it, got ''"):
        Method([TrainColor("geometry"), Train(), Lift("geometry")])
