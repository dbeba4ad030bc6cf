"""What several areas need: a small procedural scene, read once, and the configuration composed as on the command line."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from vlgs.config import CONF
from vlgs.types import Scene

TINY = (
    "data.width=48",
    "data.height=36",
    "data.train_views=6",
    "data.test_views=2",
    "data.points=400",
    "codec.training.steps=30",
    "progress=false",
)
"""Overrides under which a run takes a second or two."""


def composed(*overrides: str) -> DictConfig:
    """The configuration of `python -m vlgs.run <overrides>`."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(overrides))


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    from vlgs.data.synthetic import load_scene

    return load_scene(width=48, height=36, train_views=6, test_views=2, points=400)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real data beside the checkout; tests that need it skip without it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("needs the real data beside the checkout")
    return folder
