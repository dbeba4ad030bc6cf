"""One run is started from the configuration that was checked; a task must see no difference to `hydra.main`."""

import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

import vlgs.run
from vlgs.command import check_command


@pytest.fixture(autouse=True)
def logging_as_it_was() -> Iterator[None]:
    """Hydra sets up the logging of the whole process."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers, root.level = handlers, level


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[Any, Any]]:
    """What the task was given, and Hydra's own part, without the one word that `hydra.main` adds for itself."""
    monkeypatch.chdir(tmp_path)
    found = []

    def run(config: DictConfig) -> int:
        own: Any = OmegaConf.to_container(HydraConfig.get())
        given = own["overrides"]["hydra"]
        own["overrides"]["hydra"] = [word for word in given if word != "hydra.mode=RUN"]
        found.append((OmegaConf.to_container(config), own))
        return 0

    monkeypatch.setattr(vlgs.run, "run", run)
    return found


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", [vlgs.run.__file__, *arguments])
    GlobalHydra.instance().clear()
    try:
        vlgs.run.command()
    finally:
        GlobalHydra.instance().clear()


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("seed=1", "method=best", "trainer=fast"),
        ("data=colmap", "data.root=~/a scene, (1)", "hydra.job.name=mine"),
    ],
    ids=" ".join,
)
def test_a_run_sees_what_hydra_would_give_it(
    arguments: tuple[str, ...], seen: list[tuple[Any, Any]], monkeypatch: pytest.MonkeyPatch
):
    call(monkeypatch, *arguments)
    monkeypatch.setattr(vlgs.run, "run_task", lambda main, composed: main())
    call(monkeypatch, *arguments)
    ours, hydras = seen
    assert ours == hydras


@pytest.mark.parametrize("more", ["-m", "--cfg=job", "--info=config", "--run", "hydra.mode=RUN"])
def test_what_is_more_than_a_run_is_left_to_hydra(more: str):
    assert check_command(["seed=1"]) is not None
    assert check_command(["seed=1", more]) is None


def test_options_of_a_folder_are_left_to_hydra(
    seen: list[tuple[Any, Any]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    (tmp_path / "trainer").mkdir()
    (tmp_path / "trainer/mine.yaml").write_text("defaults: [default]\niterations: 7\n")
    call(monkeypatch, f"--config-dir={tmp_path}", "trainer=mine")
    ((config, own),) = seen
    assert config["trainer"]["iterations"] == 7
    assert "command-line" in [source["provider"] for source in own["runtime"]["config_sources"]]


def test_hydra_reports_an_error_that_is_no_fault_of_the_user(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    def run(config: DictConfig) -> int:
        raise RuntimeError("ours")

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(vlgs.run, "run", run)
    with pytest.raises(SystemExit) as end:
        call(monkeypatch, "seed=1")
    assert end.value.code == 1
    said = capsys.readouterr().err
    assert "Error executing job with overrides: ['seed=1']" in said
    assert "RuntimeError: ours" in said
