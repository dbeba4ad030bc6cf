"""torch's compiler is loaded by who compiles, and by nobody else."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from vlgs.training.lean_dynamo import _WholeFirst
from vlgs.training.lean_import import _Hidden

STEPS = """
import sys
import torch
import vlgs.training
from lightning.fabric.wrappers import OptimizedModule

def loaded():
    return "torch._dynamo.eval_frame" in sys.modules

weight = torch.nn.Parameter(torch.ones(2))
for make in (torch.optim.Adam, torch.optim.SGD):
    optimizer = make([weight], lr=0.1)
    weight.grad = torch.ones(2)
    optimizer.step()
    optimizer.zero_grad()
    optimizer.load_state_dict(optimizer.state_dict())
module = torch.nn.Linear(2, 1)
print(loaded(), isinstance(module, OptimizedModule), *weight.tolist())
"""
COMPILED = f"""{STEPS}
compiled = torch.compile(module, backend="eager")
same = torch.equal(compiled(weight), module(weight))
print(loaded(), isinstance(compiled, OptimizedModule), isinstance(module, OptimizedModule), same)

import torch._dynamo.config
from lightning.pytorch.utilities.compile import to_uncompiled
print(torch._dynamo.config.__name__, torch._dynamo.OptimizedModule is type(compiled), sys.modules["torch._dynamo"] is torch._dynamo)
optimizer.step()
"""
SUBMODULE_FIRST = """
import vlgs.training
import torch._dynamo.config
print(torch._dynamo.config.__name__, torch._dynamo.OptimizedModule.__module__)
"""
LOADED_BEFORE = """
import torch._dynamo
before = torch._dynamo.OptimizedModule
import vlgs.training
from lightning.fabric.wrappers import OptimizedModule
print(OptimizedModule is before is torch._dynamo.OptimizedModule)
"""


def said(program: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


def test_a_step_of_an_optimizer_loads_no_compiler():
    assert [line.split()[:2] for line in said(STEPS)] == [["False", "False"]]


@pytest.mark.slow
def test_a_compilation_after_a_step_loads_it():
    first, second, third = said(COMPILED)
    assert first.split()[:2] == ["False", "False"]
    assert second.split() == ["True", "True", "False", "True"]
    assert third.split() == ["torch._dynamo.config", "True", "True"]


@pytest.mark.slow
def test_a_part_of_the_compiler_loads_the_whole():
    assert said(SUBMODULE_FIRST) == ["torch._dynamo.config torch._dynamo.eval_frame"]


@pytest.mark.slow
def test_a_compiler_that_is_loaded_stays():
    assert said(LOADED_BEFORE) == ["True"]


@pytest.mark.parametrize("finder", [_WholeFirst(), _Hidden(["torch"])])
def test_other_packages_are_found_by_others(
    finder: _WholeFirst | _Hidden, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "meta_path", [finder, *sys.meta_path])
    folder = tmp_path / f"without_init_{type(finder).__name__}"  # its path is no list
    folder.mkdir()
    (folder / "part.py").write_text("value = 3\n")
    assert importlib.import_module(f"{folder.name}.part").value == 3
