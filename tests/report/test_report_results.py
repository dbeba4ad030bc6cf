"""metrics.json, where it came from, and what the terminal shows."""

import io
import json
import math
import re
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from rich.console import Console

from vlgs.report.evaluate import Evaluation
from vlgs.report.provenance import _cpu_model, commit, machine, same_code
from vlgs.report.results import METRICS, metrics_table, write_metrics, write_queries
from vlgs.report.summary import print_summary

EVALUATION = Evaluation(
    protocol="dense@1/synthetic",
    psnr=27.5,
    ssim=0.91,
    miou=0.615,
    loc_acc=None,
    per_category={"wine glass": 0.5, "absent": None},
    per_view={"view_00": {"psnr": math.inf, "ssim": math.nan}},
    beside={"miou_other": 0.7, "hits_lerf_ovs": 3},
    reasons={"loc_acc": "no held-out view has a labelled object"},
)


def test_metrics_are_flat_and_strict_json(tmp_path: Path):
    path = tmp_path / "metrics.json"
    extra = {"seed": 3, "fps_color": math.nan, "machine": machine(), "n_gaussians": 12_345}
    written = write_metrics(path, EVALUATION, extra)

    def refuse(constant: str):
        raise AssertionError(f"{constant} is not JSON")

    assert json.loads(path.read_text(), parse_constant=refuse) == written
    assert written["psnr"] == 27.5
    assert written["miou_other"] == 0.7
    assert written["seed"] == 3
    assert written["fps_color"] is None
    assert written["per_view"] == {"view_00": {"psnr": None, "ssim": None}}
    assert list(tmp_path.iterdir()) == [path]


def test_queries_are_a_list_that_pandas_reads(tmp_path: Path):
    rows = ({"view": "v", "category": "a", "iou": 0.5}, {"view": "v", "category": "b", "iou": None})
    write_queries(tmp_path / "q.json", replace(EVALUATION, queries=rows))
    table = pd.read_json(tmp_path / "q.json")
    assert table["category"].tolist() == ["a", "b"]
    assert table["iou"].isna().tolist() == [False, True]


def test_a_failure_is_shown(tmp_path: Path):
    failed = replace(EVALUATION, failure="dense@1/all: nothing could be scored")
    console = Console(width=80, record=True, file=io.StringIO())
    print_summary(write_metrics(tmp_path / "m.json", failed, {}), {}, console)
    assert "failed: dense@1/all: nothing could be scored" in console.export_text()


def test_every_entry_is_documented(tmp_path: Path):
    written = write_metrics(tmp_path / "m.json", EVALUATION, {"seed": 0})
    undocumented = {name for name in set(written) - set(METRICS) if name != "miou_other"}
    assert undocumented == set()
    for name in METRICS:
        assert f"| `{name}` |" in metrics_table()


@pytest.mark.parametrize("extra", [{"psnr": 1.0}, {"fps_colour": 1.0}, {"reasons": {}}])
def test_unknown_or_repeated_entries_are_refused(extra: dict[str, object], tmp_path: Path):
    with pytest.raises(ValueError, match="must be listed in METRICS and new"):
        write_metrics(tmp_path / "m.json", EVALUATION, extra)
    assert not list(tmp_path.iterdir())


def test_an_older_file_survives_a_failed_write(tmp_path: Path):
    path = tmp_path / "metrics.json"
    path.write_text("old")
    with pytest.raises(TypeError):
        write_metrics(path, EVALUATION, {"machine": object()})
    assert [p.read_text() for p in tmp_path.iterdir()] == ["old"]


def test_summary_shows_scores_reasons_and_unbroken_paths(tmp_path: Path):
    written = write_metrics(tmp_path / "m.json", EVALUATION, {"n_gaussians": 12_345})
    console = Console(width=60, record=True, file=io.StringIO())
    long_path = Path("/a/rather/long/path/to/a/run/folder/of/results/overview.png")
    print_summary(written, {"pictures": long_path, "run": Path("/x")}, console)
    text = console.export_text()
    for part in ("27.50 dB", "61.5%", "12,345", "wine glass", "dense@1/synthetic"):
        assert part in text
    assert "loc_acc: no held-out view has a labelled object" in text
    assert f"pictures  {long_path}\n" in text
    assert [line.split() for line in text.splitlines() if "localisation" in line] == [
        ["localisation", "accuracy", "--"]
    ]


def printed(metrics: dict[str, Any], **paths: Path) -> list[str]:
    """Lines of a summary, without the space around them."""
    stream = io.StringIO()
    print_summary(metrics, paths, Console(file=stream, width=120))
    return [line.strip() for line in stream.getvalue().splitlines()]


def test_classes_stand_under_the_mean_of_them(tmp_path: Path):
    written = write_metrics(tmp_path / "m.json", EVALUATION, {"fps_query": 2.7})
    names = [re.split("  +", line)[0] for line in printed(written)]
    first = names.index("IoU of each class")
    assert names[first - 1 : first + 4] == [
        *("other", "IoU of each class", "wine glass", "absent", "localisation accuracy"),
    ]


def test_what_nothing_was_scored_by_is_not_said(tmp_path: Path):
    why = "the field has no language"
    colour = replace(
        EVALUATION, miou=None, per_category={}, beside={}, reasons={"miou": why, "loc_acc": why}
    )
    lines = printed(write_metrics(tmp_path / "m.json", colour, {}))
    assert [line for line in lines if why in line] == [f"miou, loc_acc: {why}"]
    assert not any("protocol" in line for line in lines)
    assert "protocol: dense@1/synthetic" in printed(write_metrics(tmp_path / "n.json", EVALUATION, {}))  # fmt: skip


def test_summary_says_what_was_skipped(tmp_path: Path):
    skips = {
        "blend_zero": {"skipped": 1500, "share": 0.25, "seconds_saved": 12.34},
        "frozen_weights": {"skipped": 7, "share": 1.0, "seconds_saved": None},
    }
    console = Console(width=90, record=True, file=io.StringIO())
    print_summary(write_metrics(tmp_path / "m.json", EVALUATION, {"skips": skips}), {}, console)
    text = console.export_text()
    assert "skipped: blend_zero" in text
    assert "1,500 (25.0%), saved ~12.3 s" in text
    assert "7 (100.0%)" in text


def test_summary_of_nothing_at_all(tmp_path: Path):
    empty = replace(EVALUATION, psnr=None, ssim=None, miou=None, per_category={}, beside={})
    console = Console(width=80, record=True, file=io.StringIO())
    print_summary(write_metrics(tmp_path / "m.json", empty, {}), {}, console)
    assert console.export_text().count("--") >= 4


def git(folder: Path, *arguments: str) -> None:
    identity = ("-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false")
    subprocess.run(
        ["git", "-C", str(folder), *identity, *arguments], check=True, capture_output=True
    )


def test_commit_of_a_checkout_and_of_an_installed_wheel(tmp_path: Path):
    package = tmp_path / "vlgs"
    package.mkdir()
    (package / "__init__.py").write_text("")
    assert commit(package) is None  # no repository
    git(tmp_path, "init")
    assert commit(package) is None  # not tracked: a wheel inside someone's repository
    (tmp_path / "notes.txt").write_text("")
    git(tmp_path, "add", ".")
    assert commit(package) is None  # no commit yet
    git(tmp_path, "commit", "-m", "first")
    clean = commit(package)
    assert clean is not None
    assert len(clean) == 40
    (tmp_path / "notes.txt").write_text("not code")
    assert commit(package) == clean
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "new.yaml").write_text("")
    assert commit(package) == f"{clean}+dirty"
    (tmp_path / "conf" / "new.yaml").unlink()
    (package / "__init__.py").write_text("x = 1")
    assert commit(package) == f"{clean}+dirty"


def test_two_commits_have_the_same_code_where_they_differ_elsewhere(tmp_path: Path):
    package = tmp_path / "vlgs"
    package.mkdir()
    git(tmp_path, "init")
    commits = []
    for name in ("vlgs/__init__.py", "notes.txt", "vlgs/more.py"):
        (tmp_path / name).write_text("")
        git(tmp_path, "add", ".")
        git(tmp_path, "commit", "-m", name)
        commits.append(commit(package))
    first, noted, more = commits
    assert same_code(first, first, package)
    assert same_code(first, noted, package)
    assert not same_code(noted, more, package)
    assert not same_code(first, f"{first}+dirty", package)
    assert not same_code(None, None, package)
    assert not same_code("0" * 40, first, package), "a commit that is not there"


def test_machine_is_described(tmp_path: Path):
    assert set(machine()) == {"cpu", "isa", "cores", "threads", "torch", "python", "system"}
    assert machine()["isa"] in ("v4", "v3", "base")
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor\t: 0\nmodel name\t: Fast CPU @ 2.7GHz\nmodel name\t: other\n")
    assert _cpu_model(cpuinfo) == "Fast CPU @ 2.7GHz"
    assert _cpu_model(tmp_path / "absent")


def test_the_summary_says_that_evaluated_views_were_trained_on():
    def said(seen: int) -> str:
        return "\n".join(printed({"reasons": {}, "test_views": 4, "test_views_seen": seen}))

    assert "3 of 4 evaluated views were trained on: these are not held-out scores" in said(3)
    assert "evaluated views" in said(3).splitlines()[1]
    assert "trained on" not in said(0)
    assert "held-out views" in said(0)


def test_names_of_strangers_are_printed_as_they_are(tmp_path: Path):
    words = {"[red]": 0.5, "[/]": 0.25, "a\x1b[31mb\nc": 0.125, "\u202egnp": None}
    hostile = replace(EVALUATION, per_category=words, reasons={"miou": "[bold]\x07"})
    metrics = write_metrics(tmp_path / "m.json", hostile, {"peak_rss_bytes": 632_270_848})
    console = Console(width=100, file=io.StringIO())
    print_summary(metrics, {}, console, first="already done, nothing computed")
    assert isinstance(console.file, io.StringIO)
    said = console.file.getvalue()
    assert said.startswith("already done, nothing computed\n")
    for text in ("[red] ", "[/] ", r"a\x1b[31mb\nc", r"\u202egnp", r"[bold]\x07", "632 MB"):
        assert text in said
    assert not {"\x1b", "\x07", "\u202e"} & set(said)
