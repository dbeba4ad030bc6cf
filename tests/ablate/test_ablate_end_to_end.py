"""Real runs, if tiny ones: a Hydra multirun fills tables, and the ablation adds what it lacks."""

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from tiny_runs import TINY

SHORT = [word for word in TINY if word != "progress=false"]
SHORT += [
    "trainer=smoke",
    "data.difficulty=hard",
    "trainer.iterations=20",
    "threads=1",
    "pictures=false",
]


@pytest.mark.slow
def test_a_multirun_fills_tables_and_the_ablation_runs_the_rest(tmp_path: Path):
    place = f"results={tmp_path}"
    multirun = [sys.executable, "-m", "vlgs.run", "-m", "gaussians.prune_on=max,opacity", "seed=0"]
    subprocess.run([*multirun, place, *SHORT], check=True, capture_output=True)
    assert len(list(tmp_path.glob("runs/*/metrics.json"))) == 2

    ablate = [sys.executable, "-m", "vlgs.ablate", "tab=prune-on", "scenes=glassware", place]
    dry = subprocess.run(
        [*ablate, "seeds=1", "dry=true", *SHORT], check=True, capture_output=True, text=True
    )
    assert dry.stdout.startswith("2 runs, 0 to do")

    done = subprocess.run([*ablate, "seeds=2", *SHORT], check=True, capture_output=True, text=True)
    assert "4 runs: 2 done, 0 running, 0 failed, 2 remaining" in done.stdout
    assert len(list(tmp_path.glob("runs/*/metrics.json"))) == 4
    cells = pd.read_csv(tmp_path / "synthetic" / "prune-on.csv", comment="#")
    assert set(cells["seeds"]) == {2}
    assert cells["mean"].notna().all()
    for name in ("curves", "indicator", "time", "prune-on"):
        assert (tmp_path / "synthetic" / "plots" / f"{name}.png").is_file()
