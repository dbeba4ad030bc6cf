"""What several areas need: a small procedural scene, read once, and the folder of real data."""

from pathlib import Path

import pytest

from vlgs.types import Scene


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    from vlgs.data.synthetic import load_scene

    return load_scene(width=48, height=36, train_views=6, test_views=2, points=400)


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SAM and CLIP of a few thousand random weights."""
    from tiny_models import save_models

    return save_models(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real data beside the checkout; tests that need it skip without it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("needs the real data beside the checkout")
    return folder
