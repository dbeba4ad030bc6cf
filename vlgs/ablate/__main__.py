"""Run what is missing of the ablation tables, then write them.

    python -m vlgs.ablate tab=ab-multi                         one table (several: tab=ab-multi,ab-cam; every one: tab=all)
    python -m vlgs.ablate tab=all seeds=3 scenes=glassware     seeds 0, 1, 2 of one scene
    python -m vlgs.ablate tab=ab-cam data=colmap data.root=PATH name=my-scene trainer=photos
    python -m vlgs.ablate tab=all hydra/launcher=processes hydra.launcher.n_jobs=2 threads=1

Keys: `tab`; `scenes` (default: all of the data set); `seeds` (a count, or a list such as 0,4,7; default 3); `name` (folder of
the tables below results, default the data set); `results`; `dry=true` only says what would run; `warm=false` starts every run
on this machine from nothing, where otherwise a parent does the imports once. Everything else goes to each run, or to Hydra's
launcher (`hydra...`; see conf/hydra/launcher/README.md). A run that exists is not run again, whoever made it: one that has a folder, or a
row of runs.csv as in a clone. Ctrl-C lets the runs save; the same command goes on. Exit status: 0 all tables are filled, 1 a run failed
(its last lines and its log are shown), 130 stopped by Ctrl-C.
"""

import os
import shlex
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any

from hydra.errors import HydraException
from rich.console import Console
from rich.markup import escape

from vlgs.ablate.job import STOP, JobOutcome
from vlgs.ablate.launch import launch
from vlgs.ablate.plan import PlannedRun, RunKey, find, plan
from vlgs.ablate.progress import Count, duration, shown
from vlgs.config import literal_override, override_value
from vlgs.identity import RunIdentity
from vlgs.runs import STOPPED, stop_signals
from vlgs.tables.benchmark import Benchmark, Composer, is_scene_file
from vlgs.tables.frame import read_lines, read_metrics
from vlgs.tables.registry import Table, choose, load_tables
from vlgs.tables.write import write_all
from vlgs.text import screen, visible

OWN_KEYS = ("tab", "scenes", "seeds", "name", "results", "dry", "warm")
SCENES = {
    "synthetic": (
        "glassware",
        "mirrors",
        "lookalikes",
        "patchwork",
        "wirework",
        "rows",
        "smallware",
        "sunroom",
    ),
    "lerf_ovs": ("ramen", "teatime", "figurines", "waldo_kitchen"),
    "ovs3d": ("bed", "bench", "room", "sofa", "lawn"),
    "mipnerf360": ("garden", "bonsai", "kitchen", "room"),
}
"""Scenes of a data set that its tables average over."""

WAIT_SECONDS = 5.0
"""Seconds between two looks at runs that another process is computing."""

TRIES = 3
"""How often a run is planned again whose worker or process was killed."""


@dataclass(frozen=True)
class Request:
    """The command line, read."""

    tables: list[Table]
    benchmark: Benchmark
    results: Path
    launcher: tuple[str, ...]
    """Overrides of `hydra` itself."""
    dry: bool
    warm: bool = False
    """Whether runs on this machine come from a warm parent."""


def main() -> None:
    """Read the command line and run the ablation."""
    if len(sys.argv) == 1 or sys.argv[1] in ("-h", "--help"):
        print(__doc__)
        return
    try:
        sys.exit(ablate(read(sys.argv[1:])))
    except (ValueError, OSError) as error:
        sys.exit(screen(f"error: {error}"))
    except KeyboardInterrupt:  # a second time
        sys.exit(STOPPED)


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
        if key == "--config-dir":
            raise ValueError(
                "ablate: --config-dir must be left out, as a table is written again without it; its rows name classes of one's "
                f"own, with plugins= (sweeps/README.md), got {argument}"
            )
        if not equals:
            raise ValueError(f"ablate: arguments must be KEY=VALUE, got {argument}")
        if key in OWN_KEYS:
            own[key] = value
        elif key.lstrip("+").startswith("hydra"):
            launcher.append(literal_override(argument))
        else:
            overrides.append(literal_override(argument))
    if "tab" not in own:
        raise ValueError("ablate: tab must be given, as tab=ab-multi or tab=all")
    switches = {"dry": own.get("dry", "false").lower(), "warm": own.get("warm", "true").lower()}
    for key, value in switches.items():
        if value not in ("true", "false"):
            raise ValueError(f"ablate: {key} must be true or false, got {value}")
    given = {key: str(value) for key, value in map(_split, overrides)}
    if "seed" in given:
        raise ValueError(f"ablate: seeds must be given as seeds=, got seed={given['seed']}")
    launcher += [o for o in overrides if o.startswith("threads=")]  # cores to ask a cluster for
    dataset = given.get("data", "synthetic")
    overrides = [f"data={dataset}", *(o for o in overrides if not o.startswith("data="))]
    scenes = _words(own.get("scenes", "")) or _scenes(dataset, given)
    name = own.get("name", dataset if dataset in SCENES else scenes[0])
    return Request(
        choose(_words(own["tab"]), load_tables()),
        Benchmark(name, tuple(overrides), scenes, _seeds(own.get("seeds", "3"))),
        Path(own.get("results", "results")),
        tuple(launcher),
        switches["dry"] == "true",
        switches["warm"] == "true",
    )


@dataclass
class Tally:
    """Failures and interruptions of the runs so far; they decide which runs are tried again."""

    failed: dict[str, str] = field(default_factory=dict)
    """Name -> why, for runs that are not tried again."""
    lost: Counter[str] = field(default_factory=Counter)

    def add(self, run: PlannedRun, outcome: JobOutcome) -> None:
        """Record the outcome of a run that had no results before. A run that was never started does not count as failed."""
        if outcome.busy or not outcome.log:
            return
        if outcome.lost:
            self.lost[run.name] += 1
            if self.lost[run.name] < TRIES:
                return
        elif outcome.done:
            return
        self.failed[run.name] = outcome.reason()


def ablate(request: Request) -> int:
    """Run what is missing, then write the tables.

    Returns:
        The exit status.
    """
    console = Console(soft_wrap=True, highlight=False)
    results, benchmark = request.results, request.benchmark
    composer = Composer(benchmark, results / benchmark.name / "recipes.json")
    planned = plan(request.tables, benchmark, composer)
    recorded = _recorded(results)
    if request.dry:
        missing, _ = _missing(planned, results, recorded, {})
        console.print(f"{len(planned)} runs, {len(missing)} to do")
        for run in missing:
            command = shlex.join(["python", "-m", "vlgs.run", *run.overrides])
            console.print(visible(f"  {command}"), markup=False)
        return 0
    benchmark.extend(results / benchmark.name / "benchmark.yaml")
    composer.save()
    # A folder of this call alone: two ablations neither mix their logs nor read each other's stop file.
    folder = results / "logs" / f"{datetime.now():%Y%m%d-%H%M%S.%f}-{os.getpid()}"
    tally = Tally()
    with stop_file(folder / STOP) as stopping:
        _run_missing(request, planned, recorded, folder, tally, stopping, console)
    for name, reason in tally.failed.items():
        text = screen(reason).replace("\n", "\n    ")
        console.print(f"[red]failed: {escape(visible(name))}[/red]\n    {escape(text)}")
    if stopping.is_set():
        console.print("stopped and saved; the same command goes on from here")
        return STOPPED
    if tally.failed and not recorded and not read_metrics(results):
        return 1  # there is nothing to write yet
    for path in write_all(results, _with_those_there(request), benchmark.name, html=True):
        console.print(visible(f"tables: {path}"), markup=False)
    return 1 if tally.failed else 0


def _with_those_there(request: Request) -> list[Table]:
    """The tables that were asked for, and those that the folder has already: its page shows all of them."""
    folder = request.results / request.benchmark.name
    found = {t.label: t for t in load_tables().values() if (folder / f"{t.label}.csv").is_file()}
    found |= {table.label: table for table in request.tables}
    return [found[label] for label in sorted(found)]


def _run_missing(
    request: Request,
    planned: Sequence[PlannedRun],
    recorded: Mapping[RunKey, Mapping[str, Any]],
    folder: Path,
    tally: Tally,
    stopping: threading.Event,
    console: Console,
) -> None:
    first, expected = 0, set[str]()
    while not stopping.is_set():
        missing, seconds = _missing(planned, request.results, recorded, tally.failed)
        for run in missing:
            if run.name in expected:  # else this would go on for ever
                tally.failed[run.name] = "it ended well, but its results are not those of this row"
        missing = [run for run in missing if run.name not in tally.failed]
        failed = len(tally.failed)
        before = Count(len(planned), len(planned) - len(missing) - failed, 0, failed, seconds)
        console.print(before.line())
        if not missing:
            return
        commands = [run.overrides for run in missing]
        numbers = range(first, first + len(missing))
        start = time.perf_counter()
        with shown(console, before, folder, numbers):
            outcomes = launch(
                commands, request.results, request.launcher, folder, first, request.warm
            )
        first += len(missing)
        if stopping.is_set():
            return
        for run, outcome in zip(missing, outcomes, strict=True):
            tally.add(run, outcome)
            if outcome.done:
                expected.add(run.name)
        console.print(
            f"  {sum(o.done for o in outcomes)} runs in {duration(time.perf_counter() - start)}"
        )
        if all(outcome.busy for outcome in outcomes):
            console.print(
                f"  waiting for another process, which computes {len(outcomes)} of the runs"
            )
            stopping.wait(WAIT_SECONDS)


def _recorded(results: Path) -> Mapping[RunKey, Mapping[str, Any]]:
    """Training times of the runs that stand in runs.csv, which tables are made of whether their folders are here or not.

    Raises:
        ValueError: If the file is not as it was written.
    """
    found: dict[RunKey, dict[str, Any]] = {}
    for line in read_lines(results):
        key = RunIdentity(line.recipe, line.data_recipe, line.seed), line.scene
        run = found.setdefault(key, {})
        if line.metric == "train_seconds":
            run[line.metric] = line.value
    return found


def _missing(
    planned: Sequence[PlannedRun],
    results: Path,
    recorded: Mapping[RunKey, Mapping[str, Any]],
    failed: Mapping[str, str],
) -> tuple[list[PlannedRun], float | None]:
    """Runs without results that are still to be tried, and the median training time of the others."""
    done = {**recorded, **find(read_metrics(results))}
    missing = [run for run in planned if run.key not in done and run.name not in failed]
    times = sorted(
        done[run.key]["train_seconds"]
        for run in planned
        if run.key in done and done[run.key].get("train_seconds") is not None
    )
    return missing, times[len(times) // 2] if times else None


@contextmanager
def stop_file(path: Path) -> Iterator[threading.Event]:
    """On Ctrl-C, SIGTERM or a closed terminal, create a file that tells all jobs, on any machine, to save and stop.

    A second signal interrupts at once.
    """
    stopping = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopping.set()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        signal.signal(number, signal.default_int_handler)

    if threading.current_thread() is not threading.main_thread():
        yield stopping
        return
    before = {number: signal.signal(number, stop) for number in stop_signals()}
    try:
        yield stopping
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _split(override: str) -> tuple[str, Any]:
    """Key and value of an argument that Hydra reads.

    Raises:
        ValueError: If it does not.
    """
    try:
        return override.partition("=")[0], override_value(override)
    except HydraException as error:
        reason = str(error).strip().partition("\n")[0]
        raise ValueError(
            f"ablate: arguments must be KEY=VALUE, got {override}: {reason}"
        ) from error


def _scenes(dataset: str, given: Mapping[str, str]) -> tuple[str, ...]:
    if "data.scene" in given:
        scene = given["data.scene"]
        return (Path(scene).stem if is_scene_file(scene) else scene,)
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
