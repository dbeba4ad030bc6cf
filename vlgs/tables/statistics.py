"""What a table may claim: paired differences from one row, most often the full model, effects of switches, and the order of the rows in the paper."""

import itertools
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vlgs.tables.fill import Filled, Place
from vlgs.tables.intervals import (
    LEVEL,
    Estimate,
    holm,
    kendall_tau,
    on_scenes_like_these,
    on_these_scenes,
    probability_above,
)
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.registry import AVERAGE, Row, Table

Verdict = Literal["holds", "reversed", "above", "below", "equivalent", "cannot be told", "no claim"]
"""``holds`` and ``reversed`` are of the paper's sign, ``above`` and ``below`` 0 where it gives none, ``equivalent`` within the margin of the
quantity. ``no claim``: too few seeds."""

_SETTING = ("data.", "trainer.iterations=")
"""Overrides of which a row may have any and still be the full model: they say where and how long it is trained."""


@dataclass(frozen=True)
class Judged:
    """An interval and what follows from it."""

    low: float
    high: float
    df: float
    p: float
    """Of no difference, after Holm's correction over the table."""
    verdict: Verdict
    within: bool
    """Whether it is shown to lie within the quantity's margin too, Holm's correction over the table's equivalences."""


@dataclass(frozen=True)
class Claim:
    """A row against the full model, or what `Table.against` says, or what a switch adds, paired by scene and seed."""

    label: str
    group: str
    metric: str
    mean: float
    """In printed units: row minus the one it is compared with, or with minus without a switch."""
    scenes: int
    agree: int
    """Scenes whose own mean has the sign of `mean`."""
    seeds: int
    """Fewest of any scene."""
    better: float
    """Probability that a run of the row is better than one of the row it is compared with; NaN for effects."""
    paper: float
    """The same difference in the paper's averages; NaN where the paper has none."""
    here: Judged | None
    """On these scenes; None with too few seeds."""
    beyond: Judged | None
    """On scenes like these; None with too few scenes."""
    effect: bool = False
    """Whether it is an effect in a table of all combinations of its switches."""

    @property
    def verdict(self) -> Verdict:
        """On these scenes."""
        return self.here.verdict if self.here else "no claim"


@dataclass(frozen=True)
class Order:
    """How well the order of rows agrees with the paper's."""

    group: str
    metric: str
    tau: float
    rows: int


@dataclass(frozen=True)
class _Contrast:
    """A weighted sum of rows."""

    label: str
    group: str
    metric: str
    weights: Mapping[int, float]
    effect: bool = False


def claims(filled: Filled) -> list[Claim]:
    """Every claim of a table, corrected as one family; quantities that are not judged (times) have none."""
    metrics = [m for m in filled.table.metrics if QUANTITIES[m].judged]
    wanted = [c for m in metrics for c in (*_against_one(filled, m), *_effects(filled, m))]
    numbers = _numbers(filled)
    found = [(c, pairs) for c in wanted if (pairs := _combined(c, numbers))]
    here = _judge(filled, found, on_these_scenes)
    beyond = _judge(filled, found, on_scenes_like_these)
    return [
        _claim(filled, c, pairs, numbers, one, other)
        for (c, pairs), one, other in zip(found, here, beyond, strict=True)
    ]


def orders(filled: Filled) -> list[Order]:
    """Kendall's tau between our averages and the paper's in each group, over the rows that have both; rows that are one run count once."""
    found = []
    for metric in filled.table.metrics:
        if not QUANTITIES[metric].judged:
            continue
        for group in dict.fromkeys(row.group for row in filled.table.rows):
            both: dict[tuple[str, ...], tuple[float, float]] = {}
            for index, row in enumerate(filled.table.rows):
                pair = _ours(filled, index, metric), _paper(filled, index, metric)
                if row.group == group and not any(map(math.isnan, pair)):
                    both.setdefault(row.overrides, pair)
            tau = kendall_tau(*zip(*both.values(), strict=True)) if len(both) > 1 else math.nan
            if math.isfinite(tau):
                found.append(Order(group, metric, tau, len(both)))
    return found


def judge(p: float, mean: float, within: bool, paper: float) -> Verdict:
    """What a corrected p-value and a difference say of the paper's sign."""
    if p > 1 - LEVEL:
        return "equivalent" if within else "cannot be told"
    if not math.isfinite(paper) or paper == 0:
        return "above" if mean > 0 else "below"
    return "holds" if (mean > 0) == (paper > 0) else "reversed"


def _judge(
    filled: Filled,
    found: Sequence[tuple[_Contrast, Mapping[str, np.ndarray]]],
    estimate: Callable[[Sequence[np.ndarray]], Estimate | None],
) -> list[Judged | None]:
    estimates = [estimate(list(pairs.values())) for _, pairs in found]
    known = {i: one for i, one in enumerate(estimates) if one is not None}
    different = dict(zip(known, holm([one.differs() for one in known.values()]), strict=True))
    margins = {i: QUANTITIES[found[i][0].metric].margin for i in known}
    beside = {i: known[i].within(margin) for i, margin in margins.items() if margin is not None}
    alike = dict(zip(beside, holm(list(beside.values())), strict=True))
    judged: list[Judged | None] = []
    for index, ((contrast, _), one) in enumerate(zip(found, estimates, strict=True)):
        if one is None:
            judged.append(None)
            continue
        p, within = different[index], alike.get(index, 1.0) <= 1 - LEVEL
        paper = _of_paper(filled, contrast)
        verdict = judge(p, one.mean, within, paper)
        judged.append(Judged(*one.interval(), one.df, p, verdict, within))
    return judged


def _claim(
    filled: Filled,
    contrast: _Contrast,
    pairs: Mapping[str, np.ndarray],
    numbers: Mapping[tuple[int, str], Mapping[str, Mapping[int, float]]],
    here: Judged | None,
    beyond: Judged | None,
) -> Claim:
    means = [float(part.mean()) for part in pairs.values()]
    mean, better = statistics.fmean(means), math.nan
    if not contrast.effect:
        both = [numbers[row, contrast.metric] for row in contrast.weights]
        runs = [[np.array(list(one[scene].values())) for scene in pairs] for one in both]
        better = probability_above(runs[0], runs[1], QUANTITIES[contrast.metric].higher_is_better)
    return Claim(
        label=contrast.label,
        group=contrast.group,
        metric=contrast.metric,
        mean=mean,
        scenes=len(means),
        agree=sum(bool(np.sign(one) == np.sign(mean)) for one in means),
        seeds=min(map(len, pairs.values())),
        better=better,
        paper=_of_paper(filled, contrast),
        here=here,
        beyond=beyond,
        effect=contrast.effect,
    )


def _numbers(filled: Filled) -> dict[tuple[int, str], dict[str, dict[int, float]]]:
    """Row and metric -> scene -> seed -> value."""
    found: dict[tuple[int, str], dict[str, dict[int, float]]] = {}
    for n in sorted(filled.numbers):  # in whatever order runs are read
        if n.column != AVERAGE:
            found.setdefault((n.row, n.metric), {}).setdefault(n.column, {})[n.seed] = n.value
    return found


def _combined(
    contrast: _Contrast, numbers: Mapping[tuple[int, str], Mapping[str, Mapping[int, float]]]
) -> dict[str, np.ndarray]:
    """Scene -> the weighted sum for every seed that all rows have."""
    parts = [(numbers.get((row, contrast.metric), {}), w) for row, w in contrast.weights.items()]
    scenes = [scene for scene in parts[0][0] if all(scene in part for part, _ in parts)]
    found = {}
    for scene in scenes:
        seeds = [seed for seed in parts[0][0][scene] if all(seed in p[scene] for p, _ in parts)]
        if seeds:
            sums = [sum(w * part[scene][seed] for part, w in parts) for seed in seeds]
            found[scene] = np.array(sums)
    return found


def _against_one(filled: Filled, metric: str) -> Iterator[_Contrast]:
    """Every row against `compared_with`; a run that has several rows in a group once."""
    if filled.table.by_category:
        return
    seen = set()
    rows = filled.table.rows
    for index, row in enumerate(rows):
        reference = compared_with(filled.table, row.group)
        if reference is None or set(row.overrides) == set(rows[reference].overrides):
            continue
        key = row.group, frozenset(row.overrides)
        if key not in seen:
            seen.add(key)
            yield _Contrast(row.label, row.group, metric, {index: 1.0, reference: -1.0})


def _effects(filled: Filled, metric: str) -> Iterator[_Contrast]:
    """What each switch adds on average over the others, and each product of switches; only where every combination has one row.

    The product of two is half of how much more the one adds with the other than without it.
    """
    rows = filled.table.rows
    names = tuple(rows[0].marks)
    combinations = [tuple(row.marks.values()) for row in rows]
    complete = len(set(combinations)) == len(rows) == 2 ** len(names)
    if filled.table.by_category or len(names) < 2 or not complete:
        return
    scale = 2.0 ** (1 - len(names))
    for size in range(1, len(names) + 1):
        for chosen in itertools.combinations(range(len(names)), size):
            signs = [math.prod(1 if marks[i] else -1 for i in chosen) for marks in combinations]
            label = " x ".join(names[i] for i in chosen)
            weights = {index: scale * sign for index, sign in enumerate(signs)}
            yield _Contrast(label, "", metric, weights, effect=True)


def compared_with(table: Table, group: str) -> int | None:
    """Row that a group's rows are compared with: the one of its own where it has one, else that of the table."""
    if not table.against:
        return _full_model(table.rows, group)
    named = [i for i, row in enumerate(table.rows) if row.label == table.against]
    own = [i for i in named if table.rows[i].group == group]
    return (own or named or [None])[0]


def _full_model(rows: Sequence[Row], group: str) -> int | None:
    full = [i for i, row in enumerate(rows) if row.overrides == ()]
    own = [i for i in full if rows[i].group == group]
    # A group on other data, or of another budget, has a full model of its own: the row that changes nothing else.
    moved = [
        i
        for i, row in enumerate(rows)
        if group
        and row.group == group
        and row.overrides
        and all(word.startswith(_SETTING) for word in row.overrides)
    ]
    return (own or moved or full or [None])[0]


def _of_paper(filled: Filled, contrast: _Contrast) -> float:
    return sum(w * _paper(filled, row, contrast.metric) for row, w in contrast.weights.items())


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
