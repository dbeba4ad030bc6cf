"""Runs that are one run: with settings that move nothing, of a class that was moved."""

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest
from safetensors.numpy import load_file
from tiny_runs import TINY, composed

from tests.fuzz.commands import command
from vlgs.run import run
from vlgs.runs import RunFolder
from vlgs.sources import sources_digest

SHORT = (
    *(*TINY, "trainer=smoke", "trainer.iterations=9", "trainer.checkpoint_every=3"),
    *("pictures=false", "threads=1", "head.training.steps=5", "data.width=24", "data.height=18"),
    *("data.train_views=3", "data.test_views=1", "data.points=60", "protocol=dense"),
)
MEASURED = ("seconds", "fps", "bytes", "machine", "skips", "commit")
"""Words in the names of metrics that are another in every run."""


def only_run(results: Path) -> RunFolder:
    (path,) = (results / "runs").iterdir()
    return RunFolder(path)


def made(folder: RunFolder) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Its metrics, without times and sizes in memory, and the bits of its last checkpoint."""
    metrics = folder.finished() or {}
    kept = {k: v for k, v in metrics.items() if not any(word in k for word in MEASURED)}
    tensors = load_file(sorted(folder.checkpoint.glob("*.safetensors"))[-1])
    return kept, {name: tensor.tobytes() for name, tensor in tensors.items()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run."""
    results = tmp_path_factory.mktemp("whole")
    assert run(composed(*SHORT, f"results={results}")) == 0
    return only_run(results)


def test_settings_that_are_no_part_of_an_id_move_nothing(whole: RunFolder, tmp_path: Path):
    others = (
        *("trainer.log_every=2", "trainer.checkpoint_every=4", "raster.memory_budget=100000000"),
        *("data.cache=null", f"head.cache_dir={tmp_path}/head", "threads=2", "progress=true"),
        *("pictures=true", "on_existing=refuse", f"results={tmp_path}/elsewhere"),
    )
    assert run(composed(*SHORT, *others)) == 0
    again = only_run(tmp_path / "elsewhere")
    assert again.path.name == whole.path.name
    assert made(again) == made(whole)


def test_a_run_with_other_questions_takes_the_models_that_are_there(whole: RunFolder):
    """Metrics and bits are those of a run that trains."""
    other, results = ("query=vocab_softmax", "protocol=lerf_ovs"), whole.path.parents[1]
    assert run(composed(*SHORT, *other, f"results={results}/alone")) == 0
    alone = only_run(results / "alone")
    assert run(composed(*SHORT, *other, f"results={results}")) == 0
    taken = RunFolder(whole.path.parent / alone.path.name)
    assert made(taken) == made(alone)
    assert made(taken)[0]["training"] == made(whole)[0]["training"]
    (mine,), (his,) = (sorted(f.checkpoint.glob("*.safetensors"))[-1:] for f in (taken, whole))
    assert mine.samefile(his)
    assert taken.curves.read_bytes() == whole.curves.read_bytes()
    assert not taken.curves.samefile(whole.curves)


@pytest.mark.slow
def test_a_plugin_whose_class_is_moved_has_its_run_and_one_that_is_edited_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    options, lab = tmp_path / "options" / "fusion", tmp_path / "my_lab"
    options.mkdir(parents=True)
    lab.mkdir()
    (lab / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)

    def told(module: str, then: str = "pass") -> str:
        (options / "gated.yaml").write_text(f"_target_: my_lab.{module}.Gated\n")
        (lab / f"{module}.py").write_text(f"from vlgs.fusion.none import NoFusion\n\nclass Gated(NoFusion):\n    {then}\n")  # fmt: skip
        importlib.invalidate_caches()
        sources_digest.cache_clear()
        given = (f"--config-dir={tmp_path}/options", "fusion=gated", "plugins=[my_lab]")
        said = command("run", [*given, f"results={tmp_path}/results", *SHORT])
        assert said.status == 0, said.text
        for name in [name for name in sys.modules if name.partition(".")[0] == "my_lab"]:
            del sys.modules[name]  # as a new process begins
        return said.text

    assert "already done" not in told("gate")
    (lab / "gate.py").unlink()
    assert "already done" in told("moved")
    assert "already done" not in told("moved", "gate = 1")
