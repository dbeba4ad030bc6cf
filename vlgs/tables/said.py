"""What a table says, in words: a line per claim, how to read it, and the order of the rows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from vlgs.tables.fill import Filled
from vlgs.tables.intervals import FEWEST_SCENES, FEWEST_SEEDS, LEVEL
from vlgs.tables.quantities import QUANTITIES
from vlgs.tables.statistics import Claim, Judged, claims, compared_with, orders
from vlgs.text import csv_line, visible

CLAIM_COLUMNS = (
    *("kind", "group", "label", "metric", "difference", "low", "high", "df", "p_holm", "verdict"),
    *("within_margin", "margin", "low_scenes_like_these", "high_scenes_like_these", "p_holm_scenes_like_these"),
    *("verdict_scenes_like_these", "scenes", "scenes_that_agree", "fewest_seeds", "probability_better", "paper"),
)  # fmt: skip


@dataclass(frozen=True)
class Said:
    """A table of claims, and sentences around it."""

    head: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    before: str
    """How to read it, or why there is none."""
    after: str
    """Order of the rows."""


def say(filled: Filled) -> Said:
    """Claims of a table by scene; one by category makes none."""
    if filled.table.by_category:
        return Said((), (), "", "")
    found = claims(filled)
    if not found:
        return Said((), (), _without_claims(filled), "")
    if not any(claim.here for claim in found):
        few = min(claim.seeds for claim in found)
        text = f"No claim is made: rows have {few} seed{'s' * (few > 1)}, and an interval needs {FEWEST_SEEDS}."
        return Said((), (), text, "")
    beyond, paper = any(c.beyond for c in found), any(math.isfinite(c.paper) for c in found)
    effects = any(c.effect for c in found)
    head = ["group"] * any(c.group for c in found)
    head += ["row", "quantity", "difference", f"{LEVEL:.0%} interval, these scenes", "df"]
    head += [f"{LEVEL:.0%} interval, scenes like these"] * beyond
    head += ["scenes that agree", "P(better)"] + ["paper"] * paper + ["p (Holm)", "verdict"]
    lines = tuple(_line(c, bool(head[0] == "group"), beyond, paper) for c in found)
    return Said(tuple(head), lines, _how_to_read(filled, found, beyond, effects), _order(filled))


def claims_csv(filled: Filled) -> str | None:
    """Every claim with all of its digits; None of a table that makes none."""
    found = [] if filled.table.by_category else claims(filled)
    if not any(claim.here for claim in found):
        return None
    lines = [f"# {visible(line)}" for line in filled.provenance]
    rows = [CLAIM_COLUMNS, *map(_csv_row, found)]
    return "\n".join([*lines, *(csv_line(row, digits=4) for row in rows), ""])


def _csv_row(claim: Claim) -> tuple[object, ...]:
    nothing = Judged(math.nan, math.nan, math.nan, math.nan, "no claim", within=False)
    here, beyond = claim.here or nothing, claim.beyond or nothing
    margin = QUANTITIES[claim.metric].margin
    return (
        *("effect" if claim.effect else "row", claim.group, claim.label, claim.metric, claim.mean),
        *(here.low, here.high, here.df, here.p, here.verdict, "yes" if here.within else "no"),
        *(math.nan if margin is None else margin, beyond.low, beyond.high, beyond.p),
        *(beyond.verdict, claim.scenes, claim.agree, claim.seeds, claim.better, claim.paper),
    )


def _line(claim: Claim, grouped: bool, beyond: bool, paper: bool) -> tuple[str, ...]:
    quantity, here = QUANTITIES[claim.metric], claim.here
    digits = quantity.digits + 1 if quantity.digits < 2 else quantity.digits
    label = f"effect of {claim.label}" if claim.effect else claim.label
    verdict = claim.verdict
    if here and here.within and verdict != "equivalent":
        verdict = f"{verdict}, within ±{quantity.margin:g}"
    if claim.beyond and claim.beyond.verdict != claim.verdict:
        verdict += f"; on scenes like these {claim.beyond.verdict}"
    cells = [
        *([claim.group] if grouped else []),
        *(label, quantity.title, f"{claim.mean:+.{digits}f}", _interval(here, digits)),
        f"{here.df:.1f}" if here else "",
        *([_interval(claim.beyond, digits)] if beyond else []),
        f"{claim.agree} of {claim.scenes}",
        "" if math.isnan(claim.better) else f"{claim.better:.2f}",
        *([f"{claim.paper:+.{digits}f}" if math.isfinite(claim.paper) else ""] if paper else []),
        _p(here.p) if here else "",
        verdict,
    ]
    return tuple(cells)


def _interval(judged: Judged | None, digits: int) -> str:
    return f"{judged.low:+.{digits}f} to {judged.high:+.{digits}f}" if judged else "none"


def _p(value: float) -> str:
    return "below 0.001" if value < 0.001 else f"{value:.3f}"


def _how_to_read(filled: Filled, found: Sequence[Claim], beyond: bool, effects: bool) -> str:
    one = f"'{filled.table.against}'" if filled.table.against else "full model"
    judged = [claim for claim in found if claim.here]
    margins = {f"±{m:g} {q.unit}": None for c in judged if (m := (q := QUANTITIES[c.metric]).margin)}  # fmt: skip
    scenes = max(claim.scenes for claim in found)
    parts = [
        f"Differences are row minus {one} of the same group, paired by scene and seed. The interval is Student's t over seeds, "
        + ("on this scene alone" if scenes == 1 else f"on these {scenes} scenes")
        + f". Verdicts follow from p, which Holm's correction over all {len(judged)} differences of the table has raised, so that an "
        "interval clear of 0 may not be enough. Seeds share the one fit of the autoencoder, or of another head, that a scene has: a row with "
        "a fit of its own differs by the luck of that, too, of which the interval knows nothing (table draws)."
    ]
    if effects:
        parts.append(
            "An effect is of rows with a switch minus those without it, over all settings of the others; a product is half of how much "
            "more the one adds with the other than without it."
        )
    if margins:
        parts.append(
            f"Equivalent: shown to lie within {', '.join(margins)} by two one-sided tests, corrected in the same way; cannot be "
            "told: neither."
        )
    if beyond:
        parts.append("The interval for scenes like these is Student's t over the means of scenes.")
    elif 1 < scenes < FEWEST_SCENES:
        parts.append(f"Nothing is said of scenes like these, which takes {FEWEST_SCENES} scenes.")
    parts.append(
        "Scenes that agree have the sign of the mean; P(better) is how often a run of the row is better than one of "
        f"{'' if filled.table.against else 'the '}{one} on the same scene."
    )
    if len(judged) < len(found):
        parts.append(f"Rows of fewer than {FEWEST_SEEDS} seeds make no claim.")
    return " ".join(parts)


def _order(filled: Filled) -> str:
    """Kendall's tau of every group."""
    found = []
    several = len({order.metric for order in orders(filled)}) > 1
    for order in orders(filled):
        of = [order.group] * bool(order.group) + [QUANTITIES[order.metric].header] * several
        found.append(f"{', '.join(of)} {order.tau:+.2f} ({order.rows} rows)".strip())
    return f"Kendall's tau with the paper's order of rows: {'; '.join(found)}." if found else ""


def _without_claims(filled: Filled) -> str:
    table = filled.table
    if not any(QUANTITIES[metric].judged for metric in filled.table.metrics):
        return "Times are not judged."
    if all(compared_with(table, row.group) is None for row in table.rows):
        return "No row is the full model, so that nothing is compared."
    one = f"'{table.against}'" if table.against else "the full model"
    return f"No row can be compared: there is no run of {one} together with another row."
