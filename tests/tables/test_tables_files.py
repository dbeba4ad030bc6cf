"""From runs to files: damage is named, formats agree, and a clone has the same tables."""

import os
import re
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from slow import with_slow
from tables_fakes import BENCHMARK, fake_runs, filled_of, value

from vlgs.identity import RESULTS_VERSION
from vlgs.runs import RunFolder
from vlgs.tables.benchmark import Benchmark
from vlgs.tables.frame import read_lines, read_metrics, tidy, to_lines, write_lines
from vlgs.tables.html import write_report
from vlgs.tables.registry import Table, load_table, load_tables
from vlgs.tables.write import write_all, write_tables

DAMAGED = {
    "cut": (lambda text: text[: len(text) // 2], "must be JSON in UTF-8"),
    "empty": (lambda text: "{}", "config_hash must be a text, got None"),
    "list": (lambda text: "[]", "content must be an object"),
    "nested": (lambda text: "[" * 100_000, "must be JSON of a run, got endless nesting"),
    "latin": (lambda text: text.replace("a cpu", "\udcff"), "must be JSON in UTF-8"),
    "word": (lambda text: text.replace('"psnr": ', '"psnr": "high", "old": '), "psnr must be a finite"),
    "nan": (lambda text: text.replace('"cup": ', '"cup": NaN, "old": ', 1), "per_category.cup must be"),
    "seed": (lambda text: text.replace('"seed": ', '"seed": "x", "old": '), "seed must be a whole"),
}  # fmt: skip


@pytest.mark.parametrize("fault", sorted(DAMAGED))
def test_a_damaged_run_is_left_out_with_a_warning_that_names_it(
    table: Table, tmp_path: Path, fault: str, caplog: pytest.LogCaptureFixture
):
    count = fake_runs(tmp_path, [table], BENCHMARK, value)
    path = min(tmp_path.glob("runs/*/metrics.json"))
    damage, said = DAMAGED[fault]
    path.write_text(damage(path.read_text()), errors="surrogateescape")
    assert len(read_metrics(tmp_path)) == count - 1
    assert f"{path}: {said}" in caplog.text
    with pytest.raises(ValueError, match=r"delete the file, and the run is reported again"):
        RunFolder(path.parent).finished()


def test_halves_of_characters_are_spelled_out_wherever_they_stand(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    for path in tmp_path.glob("runs/*/metrics.json"):
        path.write_text(
            path.read_text().replace("a cpu", r"\ud800").replace('"pot"', r'"p\udcffot"')
        )
    write_lines(to_lines(read_metrics(tmp_path)), tmp_path)
    assert r"\ud800" in (tmp_path / "runs.csv").read_text()
    assert r"p\udcffot" in (tmp_path / "categories.csv").read_text()
    assert {line.cpu for line in read_lines(tmp_path)} == {r"\ud800"}


def test_a_pipe_in_the_place_of_a_file_is_not_waited_for(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    write_lines(to_lines(read_metrics(tmp_path)), tmp_path)
    pipe = tmp_path / "categories.csv"
    pipe.unlink()
    os.mkfifo(pipe)
    # Who waits for it is let go with nothing, and fails here.
    threading.Thread(target=pipe.write_bytes, args=(b"",), daemon=True).start()
    with pytest.raises(ValueError, match=r"categories.csv: line 1 must be .* a folder or a device"):
        read_lines(tmp_path)


FAULTS = """
label: faults
caption: Faults
dataset: synthetic
metrics: [miou]
rows: [{label: Full, set: [data.faults.missed=0]}]
"""


def test_a_table_is_written_where_its_options_exist(table: Table, tmp_path: Path):
    path = tmp_path / "faults.yaml"
    path.write_text(FAULTS)
    procedural_only = load_table(path)
    photographs = Benchmark("photographs", ("data=colmap", "data.root=x"), ("x",), (0,))
    for benchmark in (BENCHMARK, photographs):
        benchmark.extend(tmp_path / benchmark.name / "benchmark.yaml")
    fake_runs(tmp_path, [table, procedural_only], BENCHMARK, value)
    fake_runs(tmp_path, [table], photographs, value)
    write_all(tmp_path, [table, procedural_only])
    assert (tmp_path / "synthetic" / "faults.csv").is_file()
    assert (tmp_path / "photographs" / "tiny.csv").is_file()
    assert not (tmp_path / "photographs" / "faults.csv").exists()

    path.write_text(FAULTS.replace("missed", "mist"))
    slip = rf"{path}: rows\[0\]\.set must be options .*data\.faults\.mist"  # in no benchmark
    with pytest.raises(ValueError, match=slip):
        write_all(tmp_path, [load_table(path)])


def test_a_damaged_benchmark_is_named_though_another_has_the_rows(table: Table, tmp_path: Path):
    for name in ("synthetic", "theirs"):
        Benchmark(name, ("data=synthetic",), ("glassware",), (0,)).extend(
            tmp_path / name / "benchmark.yaml"
        )
    fake_runs(tmp_path, [table], BENCHMARK, value)
    write_all(tmp_path, [table])
    damaged = tmp_path / "theirs" / "benchmark.yaml"
    damaged.write_text(damaged.read_text().replace("data=", "dta="))
    with pytest.raises(ValueError, match=rf"{damaged}: overrides must be options .*dta"):
        write_all(tmp_path, [table])


def test_the_report_has_its_pictures(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    filled = filled_of(table, tmp_path)
    folder = tmp_path / "synthetic"
    write_tables(folder, [filled])
    write_report(folder, [filled], tidy(to_lines(read_metrics(tmp_path))), tmp_path)
    text = (folder / "index.html").read_text()
    named = re.findall(r'(?:src|href)="([^"#]+)"', text)
    assert {"plots/tiny.png", "plots/time.png", "plots/curves.png", "plots/indicator.png"} <= set(
        named
    )
    for name in named:
        assert (folder / name).is_file(), name
    assert "one &amp; all" in text  # escaped
    assert "<b>51.0</b>" in text


@pytest.mark.parametrize(
    "content",
    with_slow(
        [
            b"",
            b"mine\n1\n",
            b"step,psnr\n\n\n10,20.0\n\xff,\xfe\n1,2,3,4,5\n20,2\0\n20",
            bytes(range(256)),
        ],
        [b"mine\n1\n", bytes(range(256))],
    ),
)
def test_a_damaged_log_costs_its_own_points_only(table: Table, tmp_path: Path, content: bytes):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    for log in (tmp_path / "runs").glob("*/log.csv"):
        log.write_bytes(content)
    (tmp_path / "synthetic").mkdir(exist_ok=True)
    filled = filled_of(table, tmp_path)
    write_report(tmp_path / "synthetic", [filled], tidy(to_lines(read_metrics(tmp_path))), tmp_path)
    assert (tmp_path / "synthetic" / "plots" / "curves.png").is_file()


def test_all_formats_say_where_the_numbers_come_from(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    BENCHMARK.extend(tmp_path / "synthetic" / "benchmark.yaml")
    write_all(tmp_path, [table])
    folder = tmp_path / "synthetic"
    for name in ("tiny.csv", "tiny.md", "tiny.tex"):
        text = (folder / name).read_text()
        for words in (
            "dense@1/synthetic",
            "abcdef",
            "a cpu",
            "seeds 0, 1",
            f"results version {RESULTS_VERSION}",
        ):
            assert words in text, (name, words)
    cells = pd.read_csv(folder / "tiny.csv", comment="#")
    assert len(cells) == 4 * 3 * 2
    assert not (folder / "tiny-claims.csv").exists()  # two seeds
    pytest.importorskip("pyarrow")
    assert len(pd.read_parquet(tmp_path / "runs.parquet")) > 12


def test_a_clone_without_the_runs_has_the_same_tables(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    BENCHMARK.extend(tmp_path / "synthetic" / "benchmark.yaml")
    write_all(tmp_path, [table], html=True)
    files = [tmp_path / "runs.csv", *sorted((tmp_path / "synthetic").glob("tiny*"))]
    before = [file.read_bytes() for file in files]
    assert len(files) == 4
    shutil.rmtree(tmp_path / "runs")
    for file in files[1:]:
        file.unlink()
    write_all(tmp_path, [table], html=True)
    assert [file.read_bytes() for file in files] == before

    for broken in ("config_hash,value\na,1\n", ""):
        files[0].write_text(broken)
        with pytest.raises(ValueError, match=r"runs.csv: line \d must be as vlgs.tables writes it"):
            write_all(tmp_path, [table])
    files[0].write_bytes(before[0].replace(b",0,dense@1", b",first,dense@1"))
    with pytest.raises(ValueError, match=r"runs.csv: line 2 must be as .*first"):
        write_all(tmp_path, [table])
    files[0].write_bytes(before[0])
    categories = tmp_path / "categories.csv"
    kept = categories.read_bytes()
    for broken in (b"config_hash,value\na,1\n", kept + b"a,b\n", kept[:-5] + b"nan\n"):
        categories.write_bytes(broken)
        with pytest.raises(ValueError, match=r"categories.csv: line \d+ must be as vlgs.tables"):
            write_all(tmp_path, [table])
    categories.unlink()
    with pytest.raises(OSError, match=r"categories\.csv"):
        write_all(tmp_path, [table])
    files[0].unlink()
    with pytest.raises(ValueError, match="must hold finished runs"):
        write_all(tmp_path, [table])
    assert [file.read_bytes() for file in files[1:]] == before[1:]


def test_runs_csv_has_a_row_per_run(table: Table, tmp_path: Path):
    machine = {"cpu": "a cpu", "isa": "v3", "threads": 2}
    fake_runs(tmp_path, [table], BENCHMARK, value, more={"machine": machine, "lpips": None})
    BENCHMARK.extend(tmp_path / "synthetic" / "benchmark.yaml")
    write_all(tmp_path, [table])
    text = (tmp_path / "runs.csv").read_text()
    assert "" not in text.splitlines()
    frame = pd.read_csv(tmp_path / "runs.csv")
    assert len(frame) == len(frame["config_hash"].unique()) == 12
    assert "lpips" not in frame  # which no run has
    assert {*frame["cpu"], *frame["isa"], *frame["threads"]} == {"a cpu", "v3", 2}
    assert set(frame["overrides"]) == {
        "data=synthetic", "data=synthetic fusion=none", "data=synthetic indicator=opacity",
    }  # fmt: skip
    one = frame[(frame["overrides"] == "data=synthetic") & (frame["scene"] == "mirrors")]
    assert sorted(one["miou"]) == pytest.approx([0.6, 0.62])
    assert "one cpu; instruction set: v3; threads: 2" in (
        tmp_path / "synthetic" / "tiny.tex"
    ).read_text().replace("a cpu", "one cpu")

    categories = pd.read_csv(tmp_path / "categories.csv")
    assert len(categories) == 12 * 3  # without the one that no view shows
    assert set(categories["kind"]) == {"other", "translucent_reflective"}
    lines = to_lines(read_metrics(tmp_path))
    known = [line for line in lines if line.value == line.value]
    read = [line._replace(overrides=None) for line in read_lines(tmp_path)]
    assert sorted(read) == sorted(known)


def test_a_table_of_earlier_code_is_written_and_says_so(
    table: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    BENCHMARK.extend(tmp_path / "synthetic" / "benchmark.yaml")
    write_all(tmp_path, [table])
    tables = tmp_path / "synthetic"
    before = (tables / "tiny.csv").read_text()
    assert "earlier code" not in (tables / "tiny.md").read_text()
    shutil.rmtree(tmp_path / "runs")
    # Recipes of another version are others: nothing but the overrides says which row a run is.
    runs = (tmp_path / "runs.csv").read_text().splitlines()
    head = runs[0].split(",")
    older = []
    for line in runs[1:]:
        cells = line.split(",")
        cells[head.index("results_version")] = "1"
        cells[head.index("recipe")] = f"old{cells[head.index('recipe')]}"
        older.append(",".join(cells))
    (tmp_path / "runs.csv").write_text("\n".join([runs[0], *older, ""]))
    write_all(tmp_path, [table])
    now = (tables / "tiny.csv").read_text()
    assert now == before.replace(f"results version {RESULTS_VERSION}", "results version 1")
    said = f"Runs of results version 1, by earlier code; today's is version {RESULTS_VERSION}."
    assert said in (tables / "tiny.md").read_text()
    assert "1 tables are of runs of results version 1" in capsys.readouterr().err

    # One run of today's code: of a table of one version, and not mixed with the rest.
    fake_runs(tmp_path, [table], replace(BENCHMARK, seeds=(0,)), value)
    write_all(tmp_path, [table])
    cells = pd.read_csv(tables / "tiny.csv", comment="#")
    assert set(cells["seeds"]) == {0, 1}


def test_a_table_of_the_papers_scenes_is_another_elsewhere(tmp_path: Path):
    for name, more in (("view", "elsewhere: own"), ("own", ""), ("twin", "same_runs_as: own")):
        (tmp_path / f"{name}.yaml").write_text(
            f"label: {name}\ncaption: words\ndataset: lerf_ovs\nmetrics: [miou]\n{more}\n"
            "rows: [{label: Without_it, set: [fusion=none]}, {label: Full, set: []}]\n"
        )
    view, own, twin = (load_table(tmp_path / f"{n}.yaml") for n in ("view", "own", "twin"))
    fake_runs(tmp_path, [own], BENCHMARK, value)
    BENCHMARK.extend(tmp_path / "synthetic" / "benchmark.yaml")
    write_all(tmp_path, [view, twin])
    names = {path.name for path in (tmp_path / "synthetic").glob("*.md")}
    assert names == {"own.md", "twin.md"}
    assert "The same runs as in tab:own" in (tmp_path / "synthetic" / "twin.md").read_text()


def test_what_stands_in_a_folder_is_written_again(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    BENCHMARK.extend(tmp_path / "synthetic" / "benchmark.yaml")
    other = replace(table, label="other")
    write_all(tmp_path, [table])
    write_all(tmp_path, [table, other], again=True)
    names = {path.name for path in (tmp_path / "synthetic").glob("*.md")}
    assert names == {"tiny.md"}
    write_all(tmp_path, [table, other])
    assert (tmp_path / "synthetic" / "other.md").is_file()


def test_runs_without_a_folder_stay_beside_new_ones(
    table: Table, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    fake_runs(tmp_path, [table], BENCHMARK, value)  # seeds 0 and 1
    BENCHMARK.extend(tmp_path / "synthetic" / "benchmark.yaml")
    write_all(tmp_path, [table])
    shutil.rmtree(tmp_path / "runs")
    again = replace(BENCHMARK, seeds=(1, 2))
    fake_runs(tmp_path, [table], again, lambda row, scene, seed: 0.9)
    write_all(tmp_path, [table])
    assert "6 runs that have no folder here are kept" in caplog.text
    frame = pd.read_csv(tmp_path / "runs.csv")
    assert set(frame["seed"]) == {0, 1, 2}
    assert len(frame["config_hash"].unique()) == 18
    assert set(frame["miou"][frame["seed"] > 0]) == {0.9}


@pytest.mark.slow
def test_tables_without_torch_on_400_runs(tmp_path: Path):
    tables = [t for t in load_tables().values() if t.label in ("ab-multi", "ab-cam", "value")]
    many = Benchmark(
        "synthetic",
        ("data=synthetic",),
        ("glassware", "mirrors", "lookalikes", "patchwork"),
        tuple(range(7)),
    )
    count = fake_runs(tmp_path, tables, many, lambda row, scene, seed: 0.5 + 0.01 * seed)
    assert count >= 400
    many.extend(tmp_path / "synthetic" / "benchmark.yaml")
    script = (
        "import sys; from vlgs.tables.__main__ import main; main(); "
        "sys.exit(sorted({'torch', 'lightning', 'hydra', 'matplotlib'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, f"results={tmp_path}", "tab=ab-multi,ab-cam,value"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "synthetic" / "ab-multi.tex").is_file()


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("results=nowhere", "must hold a benchmark"),
        pytest.param("html=maybe", "html must be true or false", marks=pytest.mark.slow),
        pytest.param("tabs=a", "must be tab=", marks=pytest.mark.slow),
    ],
)
def test_a_slip_on_the_command_line_is_one_line(argument: str, message: str, tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-m", "vlgs.tables", argument],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
