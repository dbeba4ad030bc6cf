"""Finished runs without training: what the rows of tables would leave."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vlgs.identity import RESULTS_VERSION
from vlgs.tables.benchmark import Benchmark, Composer
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
        for row in table.runnable:
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
