"""What a run costs beside its training: CPU and wall seconds of its parts, and of a small sweep from a warm parent and without one."""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vlgs.bench.record import provenance, show, write_record

RUN = ("data.scene=glassware", "data.difficulty=hard", "trainer=benchmark", "threads=1")
"""The budget of the ablation tables."""
SWEEP = ("tab=ab-multi", "scenes=glassware", "seeds=2", "data.difficulty=hard", "trainer=benchmark", "threads=1")  # fmt: skip
QUICK = ("trainer=smoke", "trainer.iterations=3", "data.width=48", "data.height=36", "data.train_views=4", "data.test_views=1", "data.points=300", "head.training.steps=5")  # fmt: skip
CACHES = ("empty", "full")
"""Whether photographs of the scene and weights of the head are in the results folder already."""


@dataclass(frozen=True)
class Part:
    """Medians over the repeats."""

    command: str
    """``help``, ``run`` or ``ablate``."""
    state: str
    """For a run its caches, one of `CACHES`; for a sweep ``warm`` or ``cold``."""
    part: str
    cpu_seconds: float
    wall_seconds: float
    repeats: int


Times = dict[str, tuple[float, float]]
"""Part -> CPU and wall seconds."""


def run_startup(quick: bool, repeats: int, sweep: bool, out: Path, seed: int) -> list[Part]:
    """Measure, write startup.csv and print it.

    Args:
        quick: With a toy scene, to see that it works.
        repeats: Processes of each kind that count; one more before them fills the caches of files and of bytecode.
        sweep: Whether to run the sweep, which takes minutes.
        out: Folder of startup.csv.
        seed: Of the first run.
    """
    header = provenance(seed, note="compiled modules are in the cache of Python")
    small = QUICK if quick else ()
    rows: list[Part] = []
    with tempfile.TemporaryDirectory(prefix="vlgs-startup-") as scratch:
        environment = os.environ | {"PYTHONPYCACHEPREFIX": f"{scratch}/compiled"}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)

        def measured(arguments: Sequence[str]) -> Times:
            return {"all": _process([sys.executable, *arguments], environment)}

        def parts(arguments: Sequence[str]) -> Times:
            done = [
                sys.executable,
                "-m",
                "vlgs.bench.startup_child",
                f"{scratch}/parts",
                *arguments,
            ]
            whole = _process(done, environment)
            return {**json.loads(Path(f"{scratch}/parts").read_text()), "all": whole}

        helps = [measured(["-m", "vlgs.run", "--help"]) for _ in range(1 + repeats)]
        rows += _medians("help", "", helps[1:])
        for state in CACHES:
            each = []
            for turn in range(repeats + 1):
                place = f"results={scratch}/{turn if state == 'empty' else 'full'}"
                own = [*RUN, *small, "progress=false", place, f"seed={seed + turn}"]
                each.append(parts(own))
            rows += _medians("run", state, each[1:])
        sweeps: dict[str, list[Times]] = {"warm": [], "cold": []}
        for turn in range(repeats * sweep):
            for state in list(sweeps)[:: 1 if turn % 2 else -1]:  # in turns
                place = f"results={scratch}/{state}{turn}"
                asked = [*SWEEP, *small, place, f"warm={str(state == 'warm').lower()}"]
                sweeps[state].append(measured(["-m", "vlgs.ablate", *asked]))
        for state, each in sweeps.items():
            rows += _medians("ablate", state, each) if each else []
    write_record(out / "startup.csv", rows, header)
    show(
        "a run beside its training",
        ("command, state, part", "CPU s", "wall s"),
        [
            (f"{r.command} {r.state} {r.part}", f"{r.cpu_seconds:.2f}", f"{r.wall_seconds:.2f}")
            for r in rows
        ],
    )
    return rows


def _medians(command: str, state: str, each: Sequence[Times]) -> list[Part]:
    return [
        Part(
            command,
            state,
            part,
            statistics.median(times[part][0] for times in each),
            statistics.median(times[part][1] for times in each),
            len(each),
        )
        for part in each[0]
    ]


def _process(command: Sequence[str], environment: dict[str, str]) -> tuple[float, float]:
    """CPU and wall seconds of a process and of those that it waited for.

    Raises:
        ValueError: If it fails; says its last line.
    """
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()[-1:]
        raise ValueError(f"bench: {' '.join(command[1:3])} must end well, got {said}")
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, wall
