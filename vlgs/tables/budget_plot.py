"""The picture of a table whose rows are trained with several budgets: what each row differs by, over iterations."""

from vlgs.tables.fill import Filled
from vlgs.tables.plots import COLORS, png
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.statistics import Claim, claims, compared_with
from vlgs.text import plot

ITERATIONS = "trainer.iterations="
"""Override that a row's budget is read from."""


def differences_by_budget(filled: Filled) -> bytes | None:
    """Differences of the first metric with their intervals on these scenes, one line per label.

    Returns:
        A PNG file, or None where rows do not have two budgets or more, or no difference can be told from runs.
    """
    budgets = _budgets(filled)
    metric = filled.table.metrics[0]
    if len(set(budgets.values())) < 2 or not QUANTITIES[metric].judged:
        return None
    lines: dict[str, list[tuple[int, Claim]]] = {}
    for claim in claims(filled):
        if claim.metric == metric and claim.group in budgets and not claim.effect:
            lines.setdefault(claim.label, []).append((budgets[claim.group], claim))
    if not lines:
        return None
    with png(6.4, 3.4) as (axes, file):
        for index, (label, points) in enumerate(lines.items()):
            points.sort(key=lambda point: point[0])
            # Lines lie beside each other, or their bars could not be told apart.
            places = [budget * 1.04 ** (index - len(lines) / 2) for budget, _ in points]
            means = [claim.mean for _, claim in points]
            sides = [_sides(claim) for _, claim in points]
            axes.errorbar(
                places,
                means,
                yerr=list(zip(*sides, strict=True)),
                fmt="o-",
                markersize=4,
                linewidth=0.9,
                capsize=2,
                color=COLORS[index % len(COLORS)],
                label=plot(label),
            )
        axes.axhline(0.0, color="black", linewidth=0.6)
        axes.set_xscale("log")
        ticks = sorted(set(budgets.values()))
        axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
        axes.minorticks_off()
        axes.set_xlabel("iterations")
        axes.set_ylabel(plot(f"{QUANTITIES[metric].title}: row minus {_reference(filled)}"))
        axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return file.getvalue()


def _budgets(filled: Filled) -> dict[str, int]:
    """Group -> iterations that all of its rows say."""
    found: dict[str, set[str]] = {}
    for row in filled.table.rows:
        said = [
            word.removeprefix(ITERATIONS) for word in row.overrides if word.startswith(ITERATIONS)
        ]
        found.setdefault(row.group, set()).update(said or [""])
    return {
        group: int(next(iter(said)))
        for group, said in found.items()
        if len(said) == 1 and next(iter(said)).isdecimal()
    }


def _sides(claim: Claim) -> tuple[float, float]:
    if claim.here is None:
        return 0.0, 0.0
    return claim.mean - claim.here.low, claim.here.high - claim.mean


def _reference(filled: Filled) -> str:
    rows = filled.table.rows
    index = compared_with(filled.table, rows[-1].group)
    return "full model" if index is None else rows[index].label
