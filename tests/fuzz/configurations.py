"""Command lines with a mistake in them: typos, wrong types, every number of the configuration set to what no number should be.

`vlgs.check` and `vlgs.run` are both given each of them (`tests.fuzz.commands.both`): they say the same, a refusal is one line that
comes before any training and leaves no run.
"""

import random
from collections.abc import Iterator
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tests.fuzz.commands import TINY, outcome
from tests.fuzz.judge import Attack
from vlgs.command import check_command
from vlgs.known import CONF, join

BAD = (
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "1e30",
    "1e-30",
    "18446744073709551616",
    "x",
    "null",
    "[]",
    "true",
)
"""Values; whether a key takes one is the key's own matter, that check and run agree is not."""

NEVER = ("nan", "inf", "-inf", "x", "[]")
"""No number of the configuration may be one of these."""

WRONG = (
    ("trainr=photos", "trainer"),
    ("+trainr=photos", "trainer"),
    ("++trainr=photos", "trainer"),
    ("+trainer.iteration=100", "trainer.iterations"),
    ("trainer.iteration=100", "trainer.iterations"),
    ("trainer=phots", "photos"),
    ("trainer=base", "smoke"),
    ("data.rot=x", "data.root"),
    ("data.rot=", "data.root"),
    ("data.root=/x", "colmap"),
    ("data=colmpa", "colmap"),
    ("fusoin=self", "fusion"),
    ("fusion=sel", "self"),
    ("fusion=", "self"),
    ("fusion=null", "none"),
    ("fusion=[self]", "self"),
    ("fusion=none,self", "-m"),
    ("fusion.widht=3", "fusion.width"),
    ("fusion.width=none", "whole number"),
    ("fusion", "KEY=VALUE"),
    ("=self", "KEY=VALUE"),
    ("", "KEY=VALUE"),
    ("~fusion", "fusion"),
    ("~seed", "seed"),
    ("~trainer.iterations", "iterations"),
    ("~data", "data"),
    ("+seed=1", "seed"),
    ("+trainer=photos", "without +"),
    ("trainer=smoke +trainer=photos", "without +"),
    ("++fusion=none", "without +"),
    ("trainer@foo=photos", "trainer=OPTION"),
    (f"trainer.iterations={'9' * 5000}", "trainer.iterations"),
    ("trainer.learning_rates.means=1e-320", "means"),
    ("trainer.learning_rates.means_final=1e-200", "means_final"),
    ("sed=1", "seed"),
    ("+sed=1", "seed"),
    ("seed=one", "seed"),
    ("seed=1.5", "seed"),
    ("seed=-1", "seed"),
    ("seed=18446744073709551616", "seed"),
    ("seed=null", "seed"),
    ("seed=???", "seed"),
    ("seed=${none}", "seed"),
    ("seed=${seed}", "seed"),
    ("threads=0", "threads"),
    ("threads=100000", "threads"),
    ("threads=two", "threads"),
    ("threads=true", "threads"),
    ("levels=all", "levels"),
    ("levels=null", "levels"),
    ("on_existing=overwrite", "on_existing"),
    ("progress=maybe", "progress"),
    ("progress=1", "progress"),
    ("pictures='no'", "pictures"),
    ("results=null", "results"),
    ("results=/dev/null", "results must be a folder"),
    ("results=/dev/null/below", "results must be a folder"),
    (f"results={'n' * 300}", "results must be a folder"),
    ("plugins=lab", "plugins"),
    ("logger=null", "logger"),
    ("logger=tensorbord", "tensorboard"),
    ("logger.loggers=null", "loggers"),
    ("logger.loggers=[1]", "loggers"),
    ("logger.loggers=x", "loggers"),
    ("+logger.level=3", "logger.level"),
    ("data.scene=kitchen", "glassware"),
    ("data.scene=null", "scene"),
    ("data.difficulty=medium", "easy"),
    ("data.width=8", "width"),
    ("data.train_views=1", "train_views"),
    ("data.test_views=3", "test_views"),
    ("data.level=4", "level"),
    ("data.faults.missed=2", "rates"),
    ("data=colmap", "data.root"),
    ("data=colmap data.root=nowhere", "nowhere"),
    ("data=colmap data.root=2024", "root"),
    ("data=lerf_ovs", "data.root"),
    ("data=lerf_ovs data.root=nowhere", "nowhere"),
    ("data=lerf_ovs data.root=nowhere data.scene=ramen", "nowhere"),
    ("data=mipnerf360_goi data.root=x data.scene=garden", "data.release.labels"),
    ("data=mipnerf360 data.root=x data.scene=nowhere", "data.images"),
    ("gaussians.init=nowhere.ply", "nowhere.ply"),
    ("head.weights=nowhere.pth", "nowhere.pth"),
    ("gaussians.color=red", "color"),
    ("gaussians.prune_on=both", "prune_on"),
    ("gaussians.init_features=random", "init_features"),
    ("gaussians.densify=null", "densify"),
    ("gaussians.densify=[]", "densify"),
    ("gaussians.densify.prune_below=0.5", "reset_to"),
    ("gaussians.densify={long_axis:true,share_weights:true}", "share_weights"),
    ("trainer.learning_rates=null", "learning_rates"),
    ("trainer.learning_rates.means=-1", "means"),
    ("trainer.skip=off", "skip"),
    ("trainer.freeze=means", "freeze"),
    ("trainer.freeze=[everything]", "freeze"),
    ("trainer.freeze=[1]", "freeze"),
    ("head.encoder_widths=[]", "width"),
    ("head.encoder_widths=[0]", "width"),
    ("head.encoder_widths=[a]", "encoder_widths"),
    ("head.training=null", "training"),
    ("head=identity head.dim=3", "dim"),
    ("head=identity fusion=self", "color_dim"),
    ("head=linear fusion=self", "color_dim"),
    ("head=linear fusion=none head.width=7", "width"),
    ("codec=identity", "head"),
    ("codec.training.steps=3", "head.training.steps"),
    ("fusion=self fusion.init=ones", "init"),
    ("indicator=per_level", "levels"),
    ("indicator=fixed indicator.value=2", "value"),
    ("indicator=learned indicator.value=1", "fixed"),
    ("blend=none blend.alpha=1", "beta"),
    ("blend.convention=papr", "convention"),
    ("blend.pairs=all", "pairs"),
    ("blend.ssim=on", "ssim"),
    ("sharing=none", "fusion"),
    ("sharing=lifted", "fusion"),
    ("sharing.means=false", "sharing"),
    ("augment=offline_sam features.weights=nowhere", "nowhere"),
    ("augment=offline augment.views=0", "views"),
    ("augment=offline augment.pairs=some", "pairs"),
    ("loss.photometric.error=huber", "error"),
    ("raster.alpha_max=1", "alpha_max"),
    ("raster.stop=never", "stop"),
    ("query=lerf", "lerf_relevancy"),
    ("query.negatives=[]", "negatives"),
    ("query.negatives=[unheard]", "unheard"),
    ("query.negatives=object", "negatives"),
    ("protocol=lerf", "lerf_ovs"),
    ("protocol=dense protocol.absent=none", "absent"),
    ("protocol=lerf_ovs protocol.constants.vote=2", "vote"),
    ("text=clip text.model=/nowhere", "nowhere"),
    ("text=bert", "clip"),
)
"""What the error must name beside it."""

GOOD = (
    *(
        "",
        "fusion=none indicator=opacity blend=none",
        "seed=7",
        "seed=0",
        "levels=joint",
        "levels=separate",
    ),
    *(
        "trainer.learning_rates.means=0",
        "trainer.learning_rates.fusion=0",
        "trainer.checkpoint_every=0",
    ),
    *(
        "gaussians.densify.start=50 gaussians.densify.stop=40",
        "gaussians.densify.stop=0",
        "data.points=0",
    ),
    *(
        "data.points=1",
        "data.test_views=0",
        "blend=uniform blend.pairs=neighbours",
        "protocol=select3d",
    ),
    *("sharing=none fusion=none", "sharing=lifted fusion=none indicator=opacity", "sharing=pos"),
    *(
        "++seed=3",
        "blend=fixed blend.value=1",
        "head=identity fusion=none",
        "head=linear fusion=none",
        "query=vocab_softmax",
    ),
    *(
        "augment=offline augment.views=1",
        "logger.loggers=[]",
        "data.faults.missed=0",
        "data.level=0",
    ),
    *("gaussians.init_features=lifted", "gaussians.color=evaluated"),
)
"""What must be taken."""


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """The lists, then `count` numbers of the configuration with a bad value; all of them if there are fewer."""
    check_command(())  # what Hydra learns on first use, every child then has
    for line, named in WRONG:
        yield _attack(folder, line.split(" ") if line else [""], named, must_refuse=True)
    for line in GOOD:
        yield _accepted(folder, line.split())
    every = [(key, value) for key in numbers() for value in BAD]
    random.Random(seed).shuffle(every)
    for key, value in every[:count]:
        name = key.rpartition(".")[2]
        yield _attack(folder, [f"{key}={value}"], name, must_refuse=value in NEVER)


def numbers() -> list[str]:
    """Keys of the default configuration that hold a number."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        plain = OmegaConf.to_container(compose("config", overrides=["trainer=smoke"]), resolve=True)
    return sorted(key for key, value in _leaves(plain, "") if _is_number(value))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _leaves(node: Any, key: str) -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict):
        for name, child in node.items():
            yield from _leaves(child, join(key, name))
    else:
        yield key, node


def _tiny(arguments: list[str]) -> list[str]:
    """The arguments on the smallest scene; another data set has other keys."""
    elsewhere = any(a.startswith("data=") and a != "data=synthetic" for a in arguments)
    other = any(a.startswith(("head=identity", "head=linear")) for a in arguments)
    given = {a.lstrip("+~").partition("=")[0] for a in arguments}
    return [
        a
        for a in TINY
        if a.partition("=")[0] not in given
        and not (elsewhere and a.startswith("data."))
        and not (other and a.startswith("head."))
    ] + list(arguments)


def _attack(folder: Path, arguments: list[str], named: str, must_refuse: bool) -> Attack:
    def call() -> None:
        outcome(_tiny(arguments), Path(mkdtemp(dir=folder)) / "here")

    return Attack(" ".join(arguments), call, must_say=named, must_refuse=must_refuse)


def _accepted(folder: Path, arguments: list[str]) -> Attack:
    def call() -> None:
        try:
            outcome(_tiny(arguments), Path(mkdtemp(dir=folder)) / "here")
        except ValueError as error:
            raise AssertionError(f"refused: {error}") from error

    return Attack(f"good: {' '.join(arguments)}", call)
