"""Statistics of a table: paired differences from the full model, and agreement with the order of the rows in the paper."""

import itertools
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from vlgs.tables.fill import Filled, Place
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import AVERAGE

RESAMPLES = 10_000
LEVEL = 0.95

Verdict = Literal["holds", "reversed", "undecided", "no claim"]


@dataclass(frozen=True)
class Difference:
    """One row against the full model, paired by scene and seed."""

    row: int
    label: str
    group: str
    metric: str
    mean: float
    """Row minus full model, in printed units."""
    low: float
    high: float
    """Bounds of the `LEVEL` confidence interval, bootstrapped over scenes and over seeds within them."""
    pairs: int
    paper: float
    """The same difference in the paper's averages; NaN where the paper has none."""
    verdict: Verdict
    """Whether the paper's sign is confirmed: the interval lies on its side of 0, on the other, or around 0."""


def paired_differences(filled: Filled, metric: str) -> list[Difference]:
    """Every row against the full model of its group, or of the table where the group has none."""
    table, out = filled.table, []
    numbers: dict[int, dict[tuple[str, int], float]] = {}
    for number in filled.numbers:
        if number.metric == metric and number.column != AVERAGE:
            numbers.setdefault(number.row, {})[number.column, number.seed] = number.value
    for index, row in enumerate(table.rows):
        reference = _full_model(filled, row.group)
        if reference is None or index == reference or not row.overrides:
            continue
        mine, full = numbers.get(index, {}), numbers.get(reference, {})
        pairs: dict[str, list[float]] = {}
        for (column, seed), value in sorted(mine.items()):  # in whatever order runs are read
            if (column, seed) in full:
                pairs.setdefault(column, []).append(value - full[column, seed])
        if not pairs:
            continue
        by_scene = [np.array(part) for part in pairs.values()]
        low, high = bootstrap_interval(by_scene, seed=index)
        paper = _paper(filled, index, metric) - _paper(filled, reference, metric)
        mean = float(np.mean([part.mean() for part in by_scene]))
        verdict = judge(low, high, paper)
        out.append(
            Difference(
                index,
                row.label,
                row.group,
                metric,
                mean,
                low,
                high,
                sum(map(len, by_scene)),
                paper,
                verdict,
            )
        )
    return out


def bootstrap_interval(by_scene: Sequence[np.ndarray], seed: int) -> tuple[float, float]:
    """Percentile interval of the mean over scenes of the mean over seeds.

    Scenes are drawn with replacement, then seeds within each; with a single number the interval is all reals.

    Args:
        by_scene: Differences of each scene, one per seed.
        seed: Of the draws.
    """
    if sum(len(part) for part in by_scene) < 2:
        return -math.inf, math.inf
    means = _resampled(tuple(map(len, by_scene)), seed) @ np.concatenate(by_scene)
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


@lru_cache(maxsize=64)
def _resampled(sizes: tuple[int, ...], seed: int) -> np.ndarray:
    """Weights of all numbers, scene after scene, in each of `RESAMPLES` means; the rows of many tables share them."""
    rng = np.random.default_rng(seed)
    draws, most = np.arange(RESAMPLES)[:, None, None], max(sizes)
    scenes = rng.integers(len(sizes), size=(RESAMPLES, len(sizes)))  # [b, k]
    drawn = np.array(sizes)[scenes][..., None]  # seeds of the scene that was drawn, [b, k, 1]
    seeds = (rng.random((*scenes.shape, most)) * drawn).astype(int)
    counts = np.arange(most) < drawn
    weights = np.zeros((RESAMPLES, sum(sizes)))
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    np.add.at(
        weights, (draws, starts[scenes][..., None] + seeds * counts), counts / drawn / len(sizes)
    )
    return weights


def judge(low: float, high: float, paper: float) -> Verdict:
    """Set an interval against the sign of the paper's difference."""
    if not math.isfinite(paper) or paper == 0:
        return "no claim"
    if low <= 0 <= high:
        return "undecided"
    return "holds" if (low > 0) == (paper > 0) else "reversed"


def kendall_tau(ours: Sequence[float], papers: Sequence[float]) -> float:
    """Kendall's tau-b of two orders; NaN with fewer than two rows or where one order is a tie throughout."""
    concordant = ties_ours = ties_papers = total = 0
    for (a, x), (b, y) in itertools.combinations(zip(ours, papers, strict=True), 2):
        total += 1
        ties_ours += a == b
        ties_papers += x == y
        concordant += int(np.sign(a - b) * np.sign(x - y))
    scale = math.sqrt((total - ties_ours) * (total - ties_papers))
    return concordant / scale if scale else math.nan


def order_agreement(filled: Filled, metric: str) -> float:
    """Kendall's tau between our averages and the paper's, over the rows that have both; see `kendall_tau`."""
    ours, papers, seen = [], [], set()
    for index, row in enumerate(filled.table.rows):
        mine, theirs = _ours(filled, index, metric), _paper(filled, index, metric)
        key = row.overrides
        if key in seen or math.isnan(mine) or math.isnan(theirs):
            continue  # rows that are one run count once
        seen.add(key)
        ours.append(mine)
        papers.append(theirs)
    return kendall_tau(ours, papers)


def sentence(filled: Filled, metric: str) -> str:
    """Which claims of the paper hold on this data, which do not, and which it cannot tell."""
    differences = paired_differences(filled, metric)
    if not differences:
        return (
            "No row can be compared: there is no run of the full model together with another row."
        )
    quantity = QUANTITIES[metric]

    def show(d: Difference) -> str:
        title = f"{d.group.partition(':')[0]} {d.label}".strip()
        interval = (
            f"[{d.low:+.{quantity.digits}f}, {d.high:+.{quantity.digits}f}]"
            if math.isfinite(d.low)
            else "[one pair, no interval]"
        )
        return f"{title} {d.mean:+.{quantity.digits}f} {interval}" + (
            f" (paper {d.paper:+.{quantity.digits}f})" if math.isfinite(d.paper) else ""
        )

    parts = [
        f"{quantity.header} against the full model, {LEVEL:.0%} intervals over scenes and seeds."
    ]
    for verdict, words in (
        ("holds", "The paper's sign holds for"),
        ("reversed", "It is reversed for"),
        ("undecided", "The data cannot tell for"),
        ("no claim", "The paper gives no number for"),
    ):
        rows = [show(d) for d in differences if d.verdict == verdict]
        if rows:
            parts.append(f"{words} {'; '.join(rows)}.")
    tau = order_agreement(filled, metric)
    if math.isfinite(tau):
        parts.append(f"Kendall's tau with the paper's order of rows: {tau:+.2f}.")
    return " ".join(parts)


def _full_model(filled: Filled, group: str) -> int | None:
    rows = list(enumerate(filled.table.rows))
    full = [i for i, row in rows if row.overrides == ()]
    own = [i for i in full if filled.table.rows[i].group == group]
    # A group on other data has a full model of its own: the row that changes nothing but the data.
    moved = [
        i
        for i, row in rows
        if group
        and row.group == group
        and row.overrides
        and all(word.startswith("data.") for word in row.overrides)
    ]
    return (own or moved or full or [None])[0]


def _ours(filled: Filled, row: int, metric: str) -> float:
    columns = (AVERAGE,) if AVERAGE in filled.columns else filled.columns
    means = [filled.cells[Place(row, column, metric)].mean for column in columns]
    return statistics.fmean(means) if means else math.nan


def _paper(filled: Filled, row: int, metric: str) -> float:
    printed = filled.table.rows[row].paper
    if filled.table.by_category or AVERAGE not in printed:
        numbers = [values[metric] for values in printed.values() if metric in values]
        return statistics.fmean(numbers) if numbers else math.nan
    return printed[AVERAGE].get(metric, math.nan)
