"""Runs that take a second or two, as on the command line."""

import copy
import functools
import re

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from vlgs.config import CONF

TINY = (
    "data.width=48",
    "data.height=36",
    "data.train_views=6",
    "data.test_views=2",
    "data.points=400",
    "gaussians.background=0",
    "head.training.steps=8",
    "head.cache_dir=null",
    "progress=false",
)
"""Overrides under which a run takes a second or two."""


def composed(*overrides: str) -> DictConfig:
    """The configuration of `python -m vlgs.run <overrides>`."""
    plain = [one for one in overrides if re.fullmatch(r"results=[\w/.-]+", one)]
    config = copy.deepcopy(_composed(*(one for one in overrides if one not in plain)))
    if plain:
        config.results = plain[-1].removeprefix("results=")
    return config


@functools.lru_cache(maxsize=128)
def _composed(*overrides: str) -> DictConfig:
    """Takes a tenth of a second; many runs differ in nothing but their folder."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(overrides))
