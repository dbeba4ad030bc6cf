"""README is short, and what it prints works: its Python, its YAML and its commands, on tiny scenes."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from colmap_scenes import write_scene
from safetensors.torch import load_file
from slow import with_slow
from tiny_runs import TINY

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
CONTRIBUTING = (ROOT / ".github/CONTRIBUTING.md").read_text()
MOST_WORDS = 900

SMOKE = (*TINY, "trainer=smoke", "trainer.iterations=10", "pictures=false", "threads=1")

GATED = "python -m vlgs.run --config-dir=my_conf fusion=gated plugins=[my_lab]"
"""Of CONTRIBUTING, after its fusion."""
SLOW = {
    "python -m vlgs.ablate tab=ab-multi": ("dry=true",),
    "python -m vlgs.tables": (),
    "python -m vlgs.check data=colmap data.root=SCENE": (),
    "python -m vlgs.run": SMOKE,
    "python -m vlgs.run fusion=none indicator=opacity blend=none": SMOKE,
    "python -m vlgs.run method=langsplat fusion=self": SMOKE,
    "python -m vlgs.run -m fusion=none,mlp,cross,self seed=0,1,2": SMOKE,
    "python -m vlgs.run data=colmap data.root=SCENE data.resize=0.5 trainer=photos method=best": (
        *("data.resize=1", "trainer.iterations=10", "pictures=false", "progress=false"),
        *("gaussians.densify.start=2", "gaussians.densify.stop=5", "threads=1"),
    ),
}
"""Command -> what makes it quick."""
ELSEWHERE = {
    "pip install torch==2.13.0": ".ci/run installs in a fresh environment",
    "pip install -e '.[test]'": ".ci/run installs in a fresh environment",
    "pytest": "this is it",
    'python -m vlgs.query RUN "wine glass" mug': "tests/opened",
    "python -m vlgs.render RUN --cameras orbit --outputs color,depth,relevancy:mug --format mp4": "tests/opened",
    "python -m vlgs.view RUN": "tests/view",
    'python -m vlgs.export RUN scene.html --words "wine glass,mug"': "tests/export",
    "python -m vlgs.sfm IMAGES SCENE": "takes real photographs: tests/sfm",
    "python -m vlgs.features data=colmap data.root=SCENE features.weights=WEIGHTS": "tests/features, with tiny weights",
    "python -m vlgs.vocabulary words.txt SCENE/language_features/vocabulary.npz": "tests/features, with tiny weights",
}
"""Commands that are not run here, and why."""


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.M | re.S)


def commands() -> list[str]:
    lines = re.findall(r"^    ((?:python|pip|pytest)\b.*)$", README, re.M)
    whole = [line.partition("  #")[0].strip() for line in lines]
    return [part.strip() for line in whole for part in line.split("&&")]


def prepare(folder: Path) -> None:
    """A scene, and the files that CONTRIBUTING tells a reader to write."""
    write_scene(folder / "SCENE")
    for text in (*blocks("python", CONTRIBUTING), *blocks("yaml", CONTRIBUTING)):
        named = re.match(r"# ([\w/]+\.\w+)\n", text)
        if named:
            path = folder / named[1]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)


def run(arguments: list[str], folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{arguments}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


def test_readme_is_short():
    prose = re.sub(r"^```.*?^```$", "", README, flags=re.M | re.S)
    assert len(prose.split()) <= MOST_WORDS


def test_every_command_is_run_or_says_why_not():
    assert sorted(set(commands())) == sorted({**SLOW, **ELSEWHERE})


def test_python_blocks_run_as_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("gsplat")
    prepare(tmp_path)
    monkeypatch.chdir(tmp_path)
    for text in blocks("python"):
        short = text.replace("STEPS = 1500", "STEPS = 20").replace("resize=0.25", "resize=1.0")
        assert short != text
        exec(compile(short, "README.md", "exec"), {"__name__": "__main__"})
        assert "Gaussians" in capsys.readouterr().out


@pytest.mark.parametrize("command", with_slow([GATED, *SLOW], SLOW))
def test_a_command_works_as_printed(command: str, tmp_path: Path):
    prepare(tmp_path)
    if "tables" in command:
        shutil.copytree(ROOT / "results/camvid", tmp_path / "results/camvid")
        for name in ("runs.csv", "categories.csv"):
            shutil.copy(ROOT / "results" / name, tmp_path / "results")
    words = shlex.split(command)[1:]
    run([*words, *{GATED: SMOKE, **SLOW}[command]], tmp_path)
    if "gated" in command:
        saved = next(tmp_path.glob("results/runs/*/checkpoint/*.safetensors"))
        assert any(name.endswith("fusion.gate.weight") for name in load_file(saved))
