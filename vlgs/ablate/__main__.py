"""Run what is missing of the ablation tables, then write them.

    python -m vlgs.ablate tab=ab-multi                         one table (several: tab=ab-multi,ab-cam; every one: tab=all)
    python -m vlgs.ablate tab=all seeds=3 scenes=glassware     seeds 0, 1, 2 of one scene
    python -m vlgs.ablate tab=ab-cam data=colmap data.root=PATH name=my-scene trainer=photos
    python -m vlgs.ablate tab=all hydra/launcher=joblib hydra.launcher.n_jobs=2 threads=1

Keys: `tab`; `scenes` (default: all of the data set); `seeds` (a count, or a list such as 0,4,7; default 3); `name` (folder of
the tables below results, default the data set); `results`; `dry=true` only says what would run. Everything else goes to each
run, or to Hydra's launcher (`hydra...`). A run that exists is not run again, whoever made it. Exit status: 0 all tables are
filled, 1 a run failed (its log is named), 130 stopped by Ctrl-C.
"""

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from vlgs.ablate.plan import PlannedRun, find, plan
from vlgs.config import split_override
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.frame import read_metrics
from vlgs.tables.registry import Table, choose, load_tables

OWN_KEYS = ("tab", "scenes", "seeds", "name", "results", "dry")
SCENES = {
    "synthetic": ("glassware", "mirrors", "lookalikes", "patchwork"),
    "lerf_ovs": ("ramen", "teatime", "figurines", "waldo_kitchen"),
    "ovs3d": ("bed", "bench", "room", "sofa", "lawn"),
    "mipnerf360": ("garden", "bonsai", "kitchen", "room"),
}
"""Scenes of a data set that its tables average over."""

WAIT_SECONDS = 5.0
"""Between two looks at runs that another process is computing."""


@dataclass(frozen=True)
class Request:
    """The command line, read."""

    tables: list[Table]
    benchmark: Benchmark
    results: Path
    launcher: tuple[str, ...]
    """Overrides of `hydra` itself."""
    dry: bool


def main() -> None:
    """Read the command line and do it."""
    if len(sys.argv) == 1 or sys.argv[1] in ("-h", "--help"):
        print(__doc__)
        return
    try:
        sys.exit(ablate(read(sys.argv[1:])))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        sys.exit(130)


def read(arguments: Sequence[str]) -> Request:
    """Split what is ours from what goes to the runs and to the launcher.

    Raises:
        ValueError: Names the key and what it must be.
    """
    own: dict[str, str] = {}
    launcher: list[str] = []
    overrides: list[str] = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals:
            raise ValueError(f"ablate: arguments must be KEY=VALUE, got {argument}")
        if key in OWN_KEYS:
            own[key] = value
        elif key.lstrip("+").startswith("hydra"):
            launcher.append(argument)
        else:
            overrides.append(argument)
    if "tab" not in own:
        raise ValueError("ablate: tab must be given, as tab=ab-multi or tab=all")
    given = dict(map(split_override, overrides))
    dataset = given.get("data", "synthetic")
    overrides = [f"data={dataset}", *(o for o in overrides if not o.startswith("data="))]
    scenes = _words(own.get("scenes", "")) or _scenes(dataset, given)
    name = own.get("name", dataset if dataset in SCENES else scenes[0])
    return Request(
        choose(_words(own["tab"]), load_tables()),
        Benchmark(name, tuple(overrides), scenes, _seeds(own.get("seeds", "3"))),
        Path(own.get("results", "results")),
        tuple(launcher),
        own.get("dry", "false").lower() in ("true", "1", "yes"),
    )


def ablate(request: Request) -> int:
    """Run what is missing.

    Returns:
        The exit status.
    """
    from vlgs.ablate.launch import launch

    console = Console(soft_wrap=True)
    planned = plan(request.tables, request.benchmark, Composer(request.benchmark))
    failed: dict[str, str] = {}
    while True:
        done = find(read_metrics(request.results))
        missing = [run for run in planned if run.key not in done and run.name not in failed]
        console.print(progress_line(planned, missing, failed, done))
        if not missing:
            break
        if request.dry:
            for run in missing:
                console.print(f"  python -m vlgs.run {' '.join(run.overrides)}", highlight=False)
            return 0
        outcomes = launch([run.overrides for run in missing], request.results, request.launcher)
        for run, outcome in zip(missing, outcomes, strict=True):
            if outcome.stopped:
                raise KeyboardInterrupt
            if not (outcome.done or outcome.busy):
                failed[run.name] = f"{outcome.tail()}\n    log: {outcome.log}"
        if all(outcome.busy for outcome in outcomes):
            time.sleep(WAIT_SECONDS)  # someone else computes what is left
    request.benchmark.write(request.results / request.benchmark.name / "benchmark.yaml")
    for name, reason in failed.items():
        console.print(f"failed: {name}\n    {reason}", style="red", highlight=False)
    return 1 if failed else 0


def progress_line(
    planned: Sequence[PlannedRun],
    missing: Sequence[PlannedRun],
    failed: Mapping[str, str],
    done: Mapping[Any, Mapping[str, Any]],
) -> str:
    """How many runs there are, how many remain, and for how long by the time of those that are done."""
    seconds = sorted(run["train_seconds"] for run in done.values() if run.get("train_seconds"))
    estimate = ""
    if missing and seconds:
        hours = len(missing) * seconds[len(seconds) // 2] / 3600
        estimate = f", about {hours:.1f} h of training one after the other"
    return (
        f"{len(planned)} runs: {len(planned) - len(missing) - len(failed)} done, {len(failed)} failed, "
        f"{len(missing)} to do{estimate}"
    )


def _scenes(dataset: str, given: Mapping[str, str]) -> tuple[str, ...]:
    if "data.scene" in given:
        return (given["data.scene"],)
    if dataset in SCENES:
        return SCENES[dataset]
    if "data.root" not in given:
        raise ValueError(f"ablate: data.root must be given with data={dataset}")
    return (Path(given["data.root"]).resolve().name,)


def _seeds(text: str) -> tuple[int, ...]:
    try:
        numbers = tuple(int(word) for word in _words(text))
    except ValueError as error:
        raise ValueError(
            f"ablate: seeds must be a count or a list of integers, got {text}"
        ) from error
    if len(numbers) == 1 and "," not in text:
        return tuple(range(numbers[0]))
    return numbers


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


if __name__ == "__main__":
    main()
