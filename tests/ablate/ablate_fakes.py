"""A run without training, and two small tables: `python ablate_fakes.py <overrides>` behaves as `python -m vlgs.run` does.

What a run shall do stands in `<results>/behave.json`: {"<fusion> <scene> <seed>": [what the first try does, the second, ...]}, each of
``ok``, ``error``, ``kill`` (SIGKILL to itself), ``orphan`` (SIGKILL to the worker that started it), ``busy``, ``wait`` (until SIGTERM, then saved), ``other`` (results of another row).
Every try adds a line to `<results>/ran.txt`. What a run would leave is computed once and kept in the folder `VLGS_FAKES`, so that the
processes of a hundred runs compose five configurations, and import nothing else.
"""

import hashlib
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlgs.files import write_atomically
from vlgs.runs import BUSY, STOPPED, RunFolder

if TYPE_CHECKING:
    from omegaconf import DictConfig

TABLE = """
label: tiny
caption: words
dataset: lerf_ovs
scenes: {ramen: ramen}
metrics: [miou]
rows:
  - {label: Without, set: [fusion=none], paper: {avg: 40.0}}
  - {label: Full, set: [], paper: {avg: 50.0}}
"""


def run_faked(config: "DictConfig") -> None:
    """`vlgs.ablate.job.run_job`, pretending, on whichever worker this is called."""
    from vlgs.ablate import job

    job.RUN = (sys.executable, __file__)
    job.run_job(config)


def fake_metrics(overrides: list[str], miou: float = 0.5) -> dict[str, Any]:
    """What a run of these overrides would leave, as far as a table reads it."""
    from hydra import compose, initialize_config_dir

    from vlgs.config import CONF
    from vlgs.identity import RESULTS_VERSION, identity, run_id

    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=overrides)
    known = identity(config)
    return {
        "miou": miou,
        "psnr": 30.0,
        "train_seconds": 60.0,
        "per_category": {"cup": miou, "pot": miou - 0.1, "wall": 0.9},
        "category_kinds": {
            "cup": "translucent_reflective",
            "pot": "translucent_reflective",
            "wall": "other",
        },
        "indicator": {"edges": [-1.0, 0.0, 1.0], "other": [0.25, 0.75]},
        "seed": config.seed,
        "config_hash": run_id(config, config.data.scene),
        "recipe": known.recipe,
        "data_recipe": known.data,
        "dataset": "synthetic",
        "scene": config.data.scene,
        "protocol": "dense@1/synthetic",
        "results_version": RESULTS_VERSION,
        "commit": "abc",
        "machine": {"cpu": "a cpu"},
    }


def leave(results: Path, metrics: dict[str, Any]) -> RunFolder:
    """Write a finished run."""
    folder = RunFolder(results / "runs" / metrics["config_hash"])
    folder.path.mkdir(parents=True, exist_ok=True)
    folder.curves.write_text("step,loss,psnr,n_gaussians\n10,0.1,20.0,100\n20,0.05,25.0,120\n")
    folder.metrics.write_text(json.dumps(metrics))
    return folder


def _kept_metrics(overrides: list[str]) -> dict[str, Any]:
    """`fake_metrics`, which do not depend on the folder of results."""
    if "VLGS_FAKES" not in os.environ:
        return fake_metrics(overrides)
    told = [word for word in overrides if not word.startswith("results=")]
    name = hashlib.blake2b("\n".join(told).encode(), digest_size=8).hexdigest()
    path = Path(os.environ["VLGS_FAKES"]) / f"{name}.json"
    if not path.is_file():
        write_atomically(path, json.dumps(fake_metrics(overrides)).encode())
    return json.loads(path.read_text())


def _value(word: str) -> str:
    """The text after ``=``, without the quotes of a folder that needs some."""
    value = word.partition("=")[2]
    return value[1:-1].replace("\\'", "'") if value.startswith("'") else value


def _main(overrides: list[str]) -> int:
    given = {word.partition("=")[0]: _value(word) for word in overrides}
    results = Path(given["results"])
    key = f"{given.get('fusion', 'self')} {given['data.scene']} {given['seed']}"
    with (results / "ran.txt").open("a") as file:
        file.write(key + "\n")
    tries = (results / "ran.txt").read_text().splitlines().count(key)
    behave = results / "behave.json"
    todo = json.loads(behave.read_text()).get(key, []) if behave.is_file() else []
    act = todo[tries - 1] if tries <= len(todo) else "ok"
    if act == "error":
        print("error: fake: scene must be good, got bad", file=sys.stderr)
        return 1
    if act == "busy":
        return BUSY
    if act == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if act == "orphan":
        os.kill(os.getppid(), signal.SIGKILL)
        return 1
    if act == "wait":
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(STOPPED))
        (results / "waiting").touch()
        time.sleep(60)
    metrics = _kept_metrics([*overrides, *(["fusion=mlp"] if act == "other" else [])])
    leave(results, metrics)
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
