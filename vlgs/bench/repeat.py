"""How much of the committed tables can be had again: of each table one run, chosen at random, trained anew and compared number by number."""

import math
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vlgs.bench.record import provenance, say, show, write_record
from vlgs.config import quote_override
from vlgs.finished import read_finished
from vlgs.identity import RESULTS_VERSION
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.frame import Line, read_lines, to_lines
from vlgs.tables.registry import Table, load_tables

MEASURED = frozenset({
    "train_seconds", "fps_color", "fps_language", "fps_query", "peak_rss_bytes", "checkpoint_bytes",
})  # fmt: skip
"""Numbers of a run that are of the machine, or of the length of its file, and come out otherwise each time."""

Numbers = Mapping[tuple[str, str], float]
"""Metric and category -> value."""


@dataclass(frozen=True)
class Recorded:
    """A run that stands in runs.csv, and a row that it fills."""

    benchmark: str
    table: str
    row: str
    scene: str
    seed: int
    run: str
    cpu: str | None
    isa: str | None
    commit: str | None
    command: tuple[str, ...]
    """Arguments of `python -m vlgs.run`."""
    numbers: Numbers


@dataclass(frozen=True)
class Repeated:
    """The same run, trained again."""

    benchmark: str
    table: str
    row: str
    scene: str
    seed: int
    run: str
    """Its id in runs.csv."""
    same_id: bool
    recorded_cpu: str | None
    recorded_isa: str | None
    recorded_commit: str | None
    same_machine: bool
    """Whether CPU and instruction set are those of the recorded run; others act like another seed."""
    numbers: int
    """That are compared: all of a run but those of `MEASURED`."""
    differing: int
    largest: float
    """Largest difference of a number, as a share of the larger of both."""

    @property
    def holds(self) -> bool:
        """Whether the tables' promise is kept: the same id, and on the same CPU and instruction set the same numbers."""
        return self.same_id and (self.differing == 0 or not self.same_machine)


def run_repeat(
    results: Path,
    labels: Sequence[str],
    folders: Sequence[str],
    out: Path,
    seed: int,
    most: int | None = None,
) -> list[Repeated]:
    """Choose, train, compare, write repeat.csv and print it.

    Args:
        results: Folder of runs.csv and of the benchmarks.
        labels: Tables; none: all that stand in a benchmark's folder.
        folders: Overrides that say where the data of benchmarks of photographs lie on this machine; without any, these are left out.
        out: Folder of repeat.csv.
        seed: Of the choice.
        most: Runs at most.

    Raises:
        ValueError: If nothing can be repeated, or a run fails; what it said last is in the error.
    """
    header = provenance(seed, results=results.name, results_version=RESULTS_VERSION)
    chosen = choose_runs(results, labels, folders, seed)[:most]
    rows = []
    with tempfile.TemporaryDirectory(prefix="vlgs-repeat-") as scratch:
        for one in chosen:
            say(f"{one.benchmark}, {one.table}: {one.row}; {one.scene}, seed {one.seed}")
            rows.append(compare(one, _train(one, Path(scratch))))
            write_record(out / "repeat.csv", rows, header)
    show(
        f"{sum(row.holds for row in rows)} of {len(rows)} hold",
        ["table", "run", "numbers", "differing", "largest", "machine"],
        [_shown(row) for row in rows],
    )
    return rows


def choose_runs(
    results: Path, labels: Sequence[str], folders: Sequence[str], seed: int
) -> list[Recorded]:
    """One run of each table of each benchmark, no run twice while there are others.

    Raises:
        ValueError: If there is none of today's results version, or no such table.
    """
    tables = load_tables()
    if unknown := sorted(set(labels) - set(tables)):
        raise ValueError(f"bench: tables must be of {', '.join(tables)}, got {unknown[0]}")
    runs: dict[tuple[str, str, str, int], list[Line]] = {}
    for line in read_lines(results):
        if line.results_version == RESULTS_VERSION:
            key = line.recipe, line.data_recipe, line.scene, line.seed
            runs.setdefault(key, []).append(line)
    chosen: set[str] = set()
    found: list[Recorded] = []
    for file in sorted(results.glob("*/benchmark.yaml")):
        benchmark = Benchmark.read(file)
        if benchmark.overrides[0] != "data=synthetic":
            if not folders:
                say(f"{benchmark.name} is left out: --override says where its photographs are")
                continue
            benchmark = replace(benchmark, overrides=(*benchmark.overrides, *folders))
        composer = Composer(benchmark, file.with_name("recipes.json"))
        for label in labels or tables:
            if (file.parent / f"{label}.csv").is_file():
                own = list(_runs_of(tables[label], benchmark, composer, runs))
                fresh = [one for one in own if one.run not in chosen] or own
                if fresh:
                    found.append(random.Random(f"{seed} {file.parent.name} {label}").choice(fresh))
                    chosen.add(found[-1].run)
    if not found:
        raise ValueError(
            f"bench: {results} must hold runs.csv and tables of results version {RESULTS_VERSION} ({', '.join(labels) or 'any'}), got none"
        )
    return found


def _runs_of(
    table: Table,
    benchmark: Benchmark,
    composer: Composer,
    runs: Mapping[tuple[str, str, str, int], list[Line]],
) -> Iterable[Recorded]:
    by_scene = composer.takes_scenes()
    for row in table.rows:
        for seed in table.chosen(benchmark.seeds):
            for scene in benchmark.scenes:
                who = composer.identity(row.overrides, seed)
                lines = runs.get((who.recipe, who.data, scene, seed))
                if lines:
                    one, at = lines[0], (quote_override("data.scene", scene),) if by_scene else ()
                    threads = () if one.threads is None else (f"threads={one.threads}",)
                    yield Recorded(
                        benchmark.name, table.label, row.label, scene, seed,
                        one.config_hash, one.cpu, one.isa, one.commit,
                        (*benchmark.overrides, *row.overrides, *at, f"seed={seed}", *threads),
                        numbers_of(lines),
                    )  # fmt: skip


def _train(one: Recorded, scratch: Path) -> list[Line]:
    """Train a run in a folder that keeps traced scenes and fitted heads for the next, and nothing else."""
    command = [sys.executable, "-m", "vlgs.run", *one.command]
    command += ["pictures=false", "progress=false", f"results={scratch}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    paths = list(scratch.glob("runs/*/metrics.json"))
    if done.returncode or len(paths) != 1:
        said = (done.stderr.strip() or "nothing").splitlines()[-1]
        raise ValueError(f"bench: {' '.join(one.command)} must run, got: {said}")
    lines = to_lines([read_finished(paths[0])])
    shutil.rmtree(scratch / "runs")
    return lines


def compare(one: Recorded, lines: Sequence[Line]) -> Repeated:
    """A recorded run beside the lines of the same one, trained again."""
    now = numbers_of(lines)
    names = sorted(one.numbers.keys() | now.keys())
    shares = [_share(one.numbers.get(name, math.nan), now.get(name, math.nan)) for name in names]
    return Repeated(
        one.benchmark, one.table, one.row, one.scene, one.seed, one.run,
        same_id=lines[0].config_hash == one.run,
        recorded_cpu=one.cpu,
        recorded_isa=one.isa,
        recorded_commit=one.commit,
        same_machine=(lines[0].cpu, lines[0].isa) == (one.cpu, one.isa),
        numbers=len(names),
        differing=sum(share > 0 for share in shares),
        largest=max(shares, default=0.0),
    )  # fmt: skip


def numbers_of(lines: Iterable[Line]) -> Numbers:
    """What must come out again, of the lines of one run; a number that could not be computed is none."""
    return {
        (line.metric, line.category): line.value
        for line in lines
        if line.metric not in MEASURED and not math.isnan(line.value)
    }


def _share(before: float, now: float) -> float:
    """How far apart two numbers are, as a share of the larger; infinite where one of them is missing."""
    if before == now:
        return 0.0
    if math.isnan(before) or math.isnan(now):
        return math.inf
    return abs(now - before) / max(abs(before), abs(now))


def _shown(row: Repeated) -> list[str]:
    same = "the same" if row.same_machine else f"not {row.recorded_cpu}, {row.recorded_isa}"
    return [
        f"{row.benchmark}/{row.table}",
        row.run if row.same_id else f"{row.run}, another id now",
        str(row.numbers),
        str(row.differing),
        f"{row.largest:.1e}" if row.differing else "-",
        same,
    ]
