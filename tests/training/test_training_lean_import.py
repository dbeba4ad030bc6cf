"""What a training does not use is not imported."""

import importlib.metadata
import importlib.util
import subprocess
import sys

import pytest

from vlgs.training.lean_import import hidden

LOOK = """
import sys
import vlgs.experiment, vlgs.prepare, vlgs.run
print(*(name for name in sys.modules if name in {heavy}))
import torch, torchmetrics
print(float(torchmetrics.MeanMetric()(torch.tensor([1.0, 3.0]))))
"""
HEAVY = {"kornia", "matplotlib", "pandas", "pycolmap", "scipy.signal", "transformers"}


def test_a_run_begins_without_packages_that_it_does_not_use():
    done = subprocess.run(
        [sys.executable, "-c", LOOK.format(heavy=HEAVY)], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == ["", "2.0"]


def test_a_hidden_package_is_there_again_afterwards(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delitem(sys.modules, "plyfile", raising=False)
    with hidden("plyfile"):
        with pytest.raises(importlib.metadata.PackageNotFoundError):
            importlib.metadata.version("plyfile")
        with pytest.raises(ModuleNotFoundError, match="plyfile"):
            importlib.util.find_spec("plyfile")
        assert importlib.metadata.version("numpy")
    assert importlib.metadata.version("plyfile")
    assert importlib.util.find_spec("plyfile")
