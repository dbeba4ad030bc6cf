"""From runs to files: every number at its place, nothing filled in, and LaTeX that compiles."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from tables_fakes import fake_runs

from vlgs.identity import RESULTS_VERSION
from vlgs.runs import RunFolder
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.fill import Cell, Filled, Place, fill
from vlgs.tables.frame import read_metrics, require_one_meaning, tidy, to_lines
from vlgs.tables.grid import arrange
from vlgs.tables.html import write_report
from vlgs.tables.latex import to_latex
from vlgs.tables.registry import Row, Table, load_table, load_tables
from vlgs.tables.write import write_all, write_tables
from vlgs.text import latex as escape

BENCHMARK = Benchmark("synthetic", ("data=synthetic",), ("glassware", "mirrors"), (0, 1))

TABLE = """
label: tiny
caption: "50% of sake_cup & {more} #1 $x^2 ~ \\\\"
dataset: lerf_ovs
scenes: {ramen: ramen}
metrics: [miou, psnr]
rows:
  - {label: Without_it, group: "A: one & all", set: [fusion=none], marks: {position: true, covariance: false}, paper: {avg: 40.0}}
  - {label: Full, group: "A: one & all", set: [], marks: {position: true, covariance: true}, paper: {avg: 50.0}}
  - {label: Opacity, group: "B: other", set: [indicator=opacity], paper: {avg: 45.0}}
  - {label: Someone, group: "B: other", method: someone, paper: {avg: 41.0}}
"""


def value(row: Row, scene: str, seed: int) -> float:
    base = {"Without_it": 0.4, "Full": 0.5, "Opacity": 0.45}[row.label]
    return base + (0.1 if scene == "mirrors" else 0.0) + 0.02 * seed


@pytest.fixture
def table(tmp_path: Path) -> Table:
    path = tmp_path / "tiny.yaml"
    path.write_text(TABLE)
    return load_table(path)


def filled_of(table: Table, results: Path, benchmark: Benchmark = BENCHMARK) -> Filled:
    return fill(table, benchmark, Composer(benchmark), tidy(to_lines(read_metrics(results))))


def cell(filled: Filled, row: int, column: str, metric: str = "miou") -> Cell:
    return filled.cells[Place(row, column, metric)]


def test_means_and_deviations_are_those_of_the_runs(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    filled = filled_of(table, tmp_path)
    full = cell(filled, 1, "mirrors")
    assert full.mean == pytest.approx(61.0)
    assert full.std == pytest.approx(2 / 2**0.5)  # of 60 and 62, with n - 1
    assert full.seeds == 2
    average = cell(filled, 1, "avg")
    assert average.mean == pytest.approx(56.0)
    assert average.paper == 50.0
    assert pd.isna(average.difference)  # the scenes are not the paper's
    assert cell(filled, 1, "glassware", "psnr").mean == pytest.approx(30.51)


def test_a_missing_run_is_missing(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value, skip=[("Full", "mirrors", s) for s in (0, 1)])
    filled = filled_of(table, tmp_path)
    assert pd.isna(cell(filled, 1, "mirrors").mean)
    assert pd.isna(cell(filled, 1, "avg").mean)  # no average of half the scenes
    assert cell(filled, 1, "glassware").seeds == 2
    latex = to_latex(filled)
    assert re.search(r"Full .*--", latex)
    assert "Someone" in latex


def test_paper_values_and_differences_on_the_papers_scenes(table: Table, tmp_path: Path):
    ours = Table(
        **{**vars(table), "dataset": "synthetic", "scenes": {"g": "glassware", "m": "mirrors"}}
    )
    fake_runs(tmp_path, [ours], BENCHMARK, value)
    filled = filled_of(ours, tmp_path)
    assert filled.same_scenes
    assert cell(filled, 1, "avg").difference == pytest.approx(6.0)
    assert "(50.0, +6.0)" in to_latex(filled)


def test_best_is_bold_and_second_underlined_within_a_group(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    filled = filled_of(table, tmp_path)
    lines = arrange(filled).lines
    assert [line.entries[0].rank for line in lines] == [2, 1, 0, 0]  # alone in its group: no rank
    latex = to_latex(filled)
    assert r"\textbf{51.0}" in latex
    assert r"\underline{41.0}" in latex
    assert r"\multirow{2}{*}{A: one \& all}" in latex
    assert r"\checkmark & $\times$" in latex


def balanced(text: str) -> None:
    """Environments close in order, braces balance, and every row of a tabular has its columns."""
    open_ones: list[str] = []
    for begin, name in re.findall(r"\\(begin|end)\{(\w+)\}", text):
        if begin == "begin":
            open_ones.append(name)
        else:
            assert open_ones.pop() == name
    assert not open_ones
    plain = text.replace(r"\{", "").replace(r"\}", "")
    assert plain.count("{") == plain.count("}")
    spec = re.search(r"\\begin\{tabular\}\{(\w+)\}", text)
    assert spec is not None
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(rows) > 1
    for row in rows:
        assert row.replace(r"\&", "").count("&") == len(spec.group(1)) - 1, row


def test_latex_is_well_formed_and_compiles(table: Table, tmp_path: Path):
    results = tmp_path / "r"
    fake_runs(results, [table], BENCHMARK, value)
    BENCHMARK.extend(results / "synthetic" / "benchmark.yaml")
    write_all(results, [table])
    folder = results / "synthetic"
    text = (folder / "tiny.tex").read_text()
    balanced(text)
    assert r"50\% of sake\_cup \& \{more\} \#1 \$x\textasciicircum{}2 \textasciitilde{}" in text
    assert r"\input{tiny}" in (folder / "tables.tex").read_text()
    if shutil.which("pdflatex"):
        subprocess.run(
            ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "tables.tex"],
            cwd=folder,
            check=True,
            capture_output=True,
        )


@pytest.mark.parametrize("label", sorted(load_tables()))
def test_every_table_of_the_registry_is_well_formed_without_a_run(label: str):
    table = load_tables()[label]
    rows = tuple(
        Row(**{**vars(row), "overrides": () if row.overrides is not None else None})
        for row in table.rows  # what they override is test_tables_registry's
    )
    table = Table(**{**vars(table), "rows": rows})
    filled = fill(table, BENCHMARK, Composer(BENCHMARK), tidy([]))
    balanced(to_latex(filled))
    assert filled.cells
    assert all(pd.isna(found.mean) for found in filled.cells.values())
    assert "No runs yet" in to_latex(filled)


def test_escaping():
    assert escape("a_b%") == r"a\_b\%"


BY_CATEGORY = """
label: tiny
caption: words
dataset: lerf_ovs
scenes: {ramen: ramen}
metrics: [miou]
by: category
categories: {big_wall: other, cup: translucent_reflective}
rows:
  - {label: Without_it, set: [indicator=opacity], paper: {cup: 40.0}}
  - {label: Full, set: [], paper: {cup: 50.0}}
"""


def test_categories_of_several_scenes_by_kind(tmp_path: Path):
    path = tmp_path / "tiny.yaml"
    path.write_text(BY_CATEGORY)
    table = load_table(path)
    fake_runs(tmp_path, [table], BENCHMARK, value)
    filled = filled_of(table, tmp_path)
    lines = {line.label: line for line in arrange(filled).lines}
    assert [(line.group, line.label) for line in arrange(filled).lines] == [
        ("other", "glassware: big wall"),
        ("other", "mirrors: big wall"),
        ("other", "mean of other"),
        ("translucent_reflective", "glassware: cup"),
        ("translucent_reflective", "glassware: pot"),
        ("translucent_reflective", "mirrors: cup"),
        ("translucent_reflective", "mirrors: pot"),
        ("translucent_reflective", "mean of translucent_reflective"),
    ]  # a category that no view shows has no line
    without, full, gain = lines["mean of translucent_reflective"].entries
    assert without.mean == pytest.approx(100 * (0.41 + 0.31 + 0.51 + 0.41) / 4)
    assert gain.mean == pytest.approx(full.mean - without.mean) == pytest.approx(10.0)
    balanced(to_latex(filled))


def test_a_table_of_one_kind_shows_that_kind(tmp_path: Path):
    path = tmp_path / "tiny.yaml"
    path.write_text(BY_CATEGORY.replace("big_wall: other, ", ""))
    table = load_table(path)
    fake_runs(tmp_path, [table], BENCHMARK, value)
    assert {line.group for line in arrange(filled_of(table, tmp_path)).lines} == {
        "translucent_reflective"
    }


def test_the_papers_categories_are_found_with_blanks(tmp_path: Path):
    path = tmp_path / "tiny.yaml"
    text = BY_CATEGORY.replace("paper: {cup: 50.0}", "paper: {big_wall: 80.0}")
    path.write_text(
        text.replace("dataset: lerf_ovs", "dataset: synthetic").replace(
            "ramen: ramen", "g: glassware"
        )
    )
    one = Benchmark("synthetic", ("data=synthetic",), ("glassware",), (0,))
    table = load_table(path)
    fake_runs(tmp_path, [table], one, value)
    filled = filled_of(table, tmp_path, one)
    assert cell(filled, 1, "big wall").difference == pytest.approx(10.0)


def test_runs_that_must_not_stand_together_are_refused(table: Table, tmp_path: Path):
    fake_runs(tmp_path, [table], BENCHMARK, value)
    runs = read_metrics(tmp_path)
    twins = f"must be one, got {tmp_path}/runs/{runs[0]['config_hash']}, twin of {tmp_path}/runs.csv, whose"
    with pytest.raises(ValueError, match=twins):
        require_one_meaning(tidy(to_lines([*runs, runs[0] | {"config_hash": "twin"}])), tmp_path)
    protocols = rf"must share a protocol, got dense@1/synthetic, dense@2 in {tmp_path}/runs/"
    with pytest.raises(ValueError, match=protocols):
        require_one_meaning(
            tidy(to_lines([*runs[1:], runs[0] | {"protocol": "dense@2"}])), tmp_path
        )


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
