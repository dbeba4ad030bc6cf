"""The picture of a table with several budgets: what it draws, and of which tables there is none."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from tables_fakes import fake_runs, filled_of

from vlgs.tables.benchmark import Benchmark
from vlgs.tables.budget_plot import differences_by_budget
from vlgs.tables.fill import Filled
from vlgs.tables.registry import Row, load_table

BENCHMARK = Benchmark("synthetic", ("data=synthetic",), ("glassware", "mirrors"), (0, 1, 2))
ROWS = """
  - {label: Full, group: "GROUP", set: [trainer.iterations=BUDGET]}
  - {label: Fused, group: "GROUP", set: [fusion=mlp, trainer.iterations=BUDGET]}
"""
TABLE = (
    """
label: tiny
caption: words
dataset: synthetic
metrics: [miou, psnr]
rows:
""".strip()
    + "".join(
        ROWS.rstrip().replace("GROUP", group).replace("BUDGET", budget)
        for group, budget in (("short", "400"), ("long", "6000"))
    )
)


def value(row: Row, scene: str, seed: int) -> float:
    gain = 0.01 if row.group == "short" else -0.03 + 0.001 * seed
    return 0.5 + 0.02 * seed + (gain if row.label == "Fused" else 0.0)


def drawn_of(tmp_path: Path, text: str) -> Filled:
    path = tmp_path / "tiny.yaml"
    path.write_text(text)
    table = load_table(path)
    fake_runs(tmp_path, [table], BENCHMARK, value)
    return filled_of(table, tmp_path, BENCHMARK)


def test_differences_are_drawn_over_budgets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    bars: list[tuple[Any, ...]] = []
    whole = Axes.errorbar

    def errorbar(self: Axes, x: Any, y: Any, yerr: Any, **more: Any) -> Any:
        bars.append((more["label"], x, y, np.asarray(yerr)))
        return whole(self, x, y, yerr, **more)

    monkeypatch.setattr(Axes, "errorbar", errorbar)
    png = differences_by_budget(drawn_of(tmp_path, TABLE))
    assert png is not None
    assert png.startswith(b"\x89PNG")
    ((label, budgets, means, sides),) = bars
    assert label == "Fused"
    assert budgets == pytest.approx([400, 6000], rel=0.1)
    assert means == pytest.approx([1.0, -2.9])
    assert (sides[:, 0] < 1e-6).all()  # every seed has the same gain
    assert (sides[:, 1] > 0.05).all()


def test_a_table_of_one_budget_has_no_such_picture(tmp_path: Path):
    assert differences_by_budget(drawn_of(tmp_path, TABLE.replace("6000", "400"))) is None
