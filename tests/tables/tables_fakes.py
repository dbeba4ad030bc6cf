"""Finished runs without training: what the rows of tables would leave."""

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vlgs.identity import RESULTS_VERSION
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.fill import Cell, Filled, Place, fill
from vlgs.tables.frame import read_metrics, tidy, to_lines
from vlgs.tables.registry import Row, Table

KINDS = {"cup": "translucent_reflective", "pot": "translucent_reflective", "big wall": "other"}
Value = Callable[[Row, str, int], float]


def fake_runs(
    results: Path,
    tables: Iterable[Table],
    benchmark: Benchmark,
    value: Value,
    skip: Sequence[tuple[str, str, int]] = (),
    more: Mapping[str, Any] | None = None,
) -> int:
    """Write metrics.json of every row, scene and seed, but for those of `skip` (row label, scene, seed).

    Returns:
        How many runs there are.
    """
    composer = Composer(benchmark, results / benchmark.name / "recipes.json")
    names = set[str]()
    for table in tables:
        for row in table.rows:
            if row.label == "Someone":
                continue
            for scene in benchmark.scenes:
                for seed in benchmark.seeds:
                    if (row.label, scene, seed) in skip:
                        continue
                    known = composer.identity(row.overrides or (), seed)
                    name = f"{known.recipe[:8]}{known.data[:4]}{scene}{seed}"
                    names.add(name)
                    folder = results / "runs" / name
                    folder.mkdir(parents=True, exist_ok=True)
                    miou = value(row, scene, seed)
                    metrics = {
                        "miou": miou,
                        "loc_acc": 0.9,
                        "psnr": 30.0 + miou,
                        "ssim": 0.9,
                        "train_seconds": 60.0 + 10 * seed,
                        "fps_query": 50.0,
                        "n_gaussians": 20_000,
                        "ply_bytes": 5_000_000,
                        "per_category": {"cup": miou, "pot": miou - 0.1, "big wall": 0.9, "unseen": None},
                        "category_kinds": KINDS,
                        "indicator": {"edges": [-1.0, 0.0, 1.0], "other": [0.25, 0.75]},
                        "seed": seed,
                        "config_hash": name,
                        "recipe": known.recipe,
                        "data_recipe": known.data,
                        "dataset": "synthetic",
                        "scene": scene,
                        "protocol": "dense@1/synthetic",
                        "results_version": RESULTS_VERSION,
                        "commit": "abcdef",
                        "machine": {"cpu": "a cpu", "cores": 2},
                        "per_view": {"a": {"psnr": 30.0}},
                        "reasons": {"lpips": "no weights"},
                        **(more or {}),
                    }  # fmt: skip
                    (folder / "metrics.json").write_text(json.dumps(metrics))
                    (folder / "log.csv").write_text(
                        "step,loss,psnr,n_gaussians\n10,0.1,20.0,100\n20,0.05,25.0,120\n"
                    )
    composer.save()
    return len(names)


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
  - {label: Someone, group: "B: other", set: [fusion=cross], paper: {avg: 41.0}}
"""


def value(row: Row, scene: str, seed: int) -> float:
    base = {"Without_it": 0.4, "Full": 0.5, "Opacity": 0.45}[row.label]
    return base + (0.1 if scene == "mirrors" else 0.0) + 0.02 * seed


def filled_of(table: Table, results: Path, benchmark: Benchmark = BENCHMARK) -> Filled:
    return fill(table, benchmark, Composer(benchmark), tidy(to_lines(read_metrics(results))))


def cell(filled: Filled, row: int, column: str, metric: str = "miou") -> Cell:
    return filled.cells[Place(row, column, metric)]


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
    tabulars = re.findall(r"\\begin\{tabular\}\{(\w+)\}(.*?)\\end\{tabular\}", text, re.DOTALL)
    assert tabulars
    for spec, body in tabulars:
        rows = [line for line in body.splitlines() if line.endswith(r"\\")]
        assert len(rows) > 1
        for row in rows:
            spanned = sum(int(count) - 1 for count in re.findall(r"\\multicolumn\{(\d+)\}", row))
            assert row.replace(r"\&", "").count("&") + spanned == len(spec) - 1, row
