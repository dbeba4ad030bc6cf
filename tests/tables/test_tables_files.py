"""From runs to files: damage is named, formats agree, and a clone has the same tables."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from tables_fakes import BENCHMARK, fake_runs, filled_of, value

from vlgs.identity import RESULTS_VERSION
from vlgs.runs import RunFolder
from vlgs.tables.benchmark import Benchmark
from vlgs.tables.frame import read_metrics, tidy, to_lines
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
    [
        b"",
        b"mine\n1\n",
        b"step,psnr\n\n\n10,20.0\n\xff,\xfe\n1,2,3,4,5\n20,2\0\n20",
        bytes(range(256)),
    ],
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
    frame = pd.read_csv(tmp_path / "runs.csv")
    assert len(frame["config_hash"].unique()) == 12
    pytest.importorskip("pyarrow")
    assert len(pd.read_parquet(tmp_path / "runs.parquet")) == len(frame)


def test_a_clone_without_the_runs_has_the_same_tables(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    BENCHMARK.extend(tmp_path / "synthetic" / "benchmark.yaml")
    write_all(tmp_path, [table], html=True)
    files = [tmp_path / "runs.csv", *sorted((tmp_path / "synthetic").glob("tiny.*"))]
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
    files[0].unlink()
    with pytest.raises(ValueError, match="must hold finished runs"):
        write_all(tmp_path, [table])
    assert [file.read_bytes() for file in files[1:]] == before[1:]


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
    assert set(frame["value"][(frame["metric"] == "miou") & (frame["seed"] > 0)]) == {0.9}


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
        ("html=maybe", "html must be true or false"),
        ("tabs=a", "must be tab="),
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
