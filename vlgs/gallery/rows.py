"""The finished runs behind the rows of a table, and what their scores say of single views. Imports no torch."""

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlgs.finished import is_number
from vlgs.runs import RunFolder
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.registry import Table

SHARES = (0.003, 0.25)
"""Of a view's pixels: what is smaller cannot be seen, and what is larger is background."""


@dataclass(frozen=True)
class Answered:
    """One word in one view, as a run was scored."""

    iou: float | None
    share: float
    """Of the view's pixels, that the word's truth covers."""


@dataclass(frozen=True)
class ScoredRow:
    """A row of the table and its run of one scene and seed."""

    label: str
    folder: RunFolder
    metrics: Mapping[str, Any]
    """See `vlgs.report.results.METRICS`."""
    answers: Mapping[tuple[str, str], Answered]
    """View and word -> score under the headline's protocol; empty of a row without language."""

    @property
    def protocol(self) -> str:
        """Of the headline, without what labels it was scored on."""
        return str(self.metrics.get("protocol")).partition(" ")[0]

    def psnr(self, view: str) -> float | None:
        """Of one held-out view; None where it was not scored."""
        return (self.metrics["per_view"].get(view) or {}).get("psnr")


def rows_of(
    table: Table,
    benchmark: Benchmark,
    composer: Composer,
    seed: int,
    finished: Sequence[Mapping[str, Any]],
    runs: Path,
) -> dict[str, list[ScoredRow]]:
    """Scene -> the rows of a table that have a finished run with a kept field, in the order of the table.

    Rows that are one run stand once, under the first of their labels.

    Args:
        table: Whose rows.
        benchmark: Data and scenes.
        composer: Of the same benchmark.
        seed: Of the runs.
        finished: Contents of metrics.json files (`vlgs.tables.frame.read_metrics`).
        runs: Folder of the run folders.

    Raises:
        UnknownOptionError: If a row names an option that the benchmark's configuration does not have.
        ValueError: If a file of scores is damaged.
    """
    known = {
        (run["recipe"], run["data_recipe"], str(run["scene"]), run["seed"]): run
        for run in finished
        if "recipe" in run
    }
    found: dict[str, list[ScoredRow]] = {scene: [] for scene in benchmark.scenes}
    for row in table.rows:
        who = composer.identity(row.overrides, seed)
        for scene, rows in found.items():
            run = known.get((who.recipe, who.data, scene, seed))
            if run is None or any(run["config_hash"] == other.folder.path.name for other in rows):
                continue
            folder = RunFolder(runs / run["config_hash"])
            if folder.field.is_file():
                rows.append(read_row(row.label, folder, run))
    return found


def read_row(label: str, folder: RunFolder, metrics: Mapping[str, Any]) -> ScoredRow:
    """A row with the scores of its single words.

    Raises:
        ValueError: If queries.json or the scores by view are not as a run writes them.
    """
    for view, scores in (metrics.get("per_view") or {}).items():
        if not isinstance(scores, dict) or not _is_known(scores.get("psnr")):
            raise ValueError(
                f"{folder.metrics}: per_view.{view} must hold a psnr, got {scores!r:.80}; delete the file, and the run is reported again"
            )
    row = ScoredRow(label, folder, {**metrics, "per_view": metrics.get("per_view") or {}}, {})
    if not folder.queries.is_file():
        return row
    try:
        scored = [_answered(one, row.protocol) for one in json.loads(folder.queries.read_bytes())]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(
            f"{folder.queries}: must be a list of scored words as vlgs.run writes it, got: {error!s:.120}; delete it and metrics.json, "
            "and the run is reported again"
        ) from error
    return ScoredRow(label, folder, row.metrics, dict(filter(None, scored)))


def _answered(content: Any, protocol: str) -> tuple[tuple[str, str], Answered] | None:
    """One entry of queries.json; None of another protocol, or where nothing is to be seen of the word."""
    names = tuple(content[key] for key in ("protocol", "view", "category"))
    numbers = tuple(content[key] for key in ("true_pixels", "pixels"))
    if not all(isinstance(name, str) for name in names) or not all(map(is_number, numbers)):
        raise ValueError(f"an entry {content!r:.80}")
    if not _is_known(content["iou"]):
        raise ValueError(f"iou {content['iou']!r:.80}")
    if names[0] != protocol or numbers[0] <= 0 or numbers[1] <= 0:
        return None
    return (names[1], names[2]), Answered(content["iou"], numbers[0] / numbers[1])


def _is_known(value: Any) -> bool:
    return value is None or is_number(value)


def choose_views(rows: Sequence[ScoredRow]) -> dict[str, str]:
    """Place -> the held-out view with the lowest, and the one with the highest mean PSNR over the rows that have one.

    Only views that all of these rows have been scored on are compared; where there is one such view it is the lowest, and where there is
    none there is nothing to choose.
    """
    colored = [row for row in rows if any(row.psnr(v) is not None for v in row.metrics["per_view"])]
    means: dict[str, float] = {}
    for view in colored[0].metrics["per_view"] if colored else ():
        values = [value for row in colored if (value := row.psnr(view)) is not None]
        if len(values) == len(colored):
            means[view] = statistics.fmean(values)
    if not means:
        return {}
    lowest, highest = min(means, key=means.__getitem__), max(means, key=means.__getitem__)
    return {"lowest": lowest} if len(means) == 1 else {"lowest": lowest, "highest": highest}


def choose_word(rows: Sequence[ScoredRow], view: str) -> str | None:
    """The word on which the rows differ most in a view: the largest standard deviation of its IoU over the rows that know language.

    Words whose truth covers less or more of the view than `SHARES` are left out. Among equals the first in the alphabet is taken.
    """
    asked = [row for row in rows if row.answers]
    words = sorted({word for row in asked for seen, word in row.answers if seen == view})
    spread: dict[str, float] = {}
    for word in words:
        scores = [found for row in asked if (found := row.answers.get((view, word))) is not None]
        ious = [score.iou for score in scores if score.iou is not None]
        if len(ious) == len(asked) and SHARES[0] <= scores[0].share <= SHARES[1]:
            spread[word] = statistics.pstdev(ious)
    return max(spread, key=spread.__getitem__) if spread else None
