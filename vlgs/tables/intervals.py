"""What a few seeds of a few scenes can say: t intervals, tests, Holm's correction and Kendall's tau. Plain numbers, no tables.

A comparison is given as numbers of scenes, one array per scene with one number per seed. Two statements can be made of them:

- on these scenes (`on_these_scenes`): the scenes are what they are, and only the seeds are a sample. Another seed of the same scenes lies
  in the interval;
- on scenes like these (`on_scenes_like_these`): the scenes are a sample too, and their means are the units. It needs `FEWEST_SCENES`.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

LEVEL = 0.95
"""Of every interval; 1 - LEVEL is the error of every family of tests."""

FEWEST_SEEDS = 3
"""Per scene. With two, the interval covers 91 to 98 % instead of 95 %, depending on how much scenes differ; with one there is none."""

FEWEST_SCENES = 5
"""To speak of scenes like these. The t interval of fewer is right but so wide that it says nothing: of three scenes 4.3 standard errors."""


@dataclass(frozen=True)
class Estimate:
    """A mean, its standard error, and the degrees of freedom of that error."""

    mean: float
    error: float
    df: float

    def interval(self) -> tuple[float, float]:
        """Bounds of the two-sided t interval of `LEVEL`."""
        half = float(stdtrit(self.df, 0.5 + LEVEL / 2)) * self.error
        return self.mean - half, self.mean + half

    def differs(self) -> float:
        """Two-sided p-value of a true mean of 0."""
        if self.error == 0:
            return float(self.mean == 0)
        return float(2 * stdtr(self.df, -abs(self.mean) / self.error))

    def within(self, margin: float) -> float:
        """P-value of a true mean beyond the margin on either side: the larger one of two one-sided tests (Schuirmann, 1987)."""
        inside = margin - abs(self.mean)
        if self.error == 0:
            return float(inside <= 0)
        return float(stdtr(self.df, -inside / self.error))


def on_these_scenes(by_scene: Sequence[np.ndarray]) -> Estimate | None:
    """Mean over these scenes of what seeds give on average; None with fewer than `FEWEST_SEEDS` in any scene.

    Every scene has a variance of its own, and the degrees of freedom are Satterthwaite's: up to scenes * (seeds - 1) where all
    variances are alike, down to seeds - 1 where one scene has all of it.
    """
    if not by_scene or min(map(len, by_scene)) < FEWEST_SEEDS:
        return None
    variances = np.array([part.var(ddof=1) / len(part) for part in by_scene]) / len(by_scene) ** 2
    freedom = np.array([len(part) - 1.0 for part in by_scene])
    whole, mean = variances.sum(), float(np.mean([part.mean() for part in by_scene]))
    shares = variances / whole if whole > 0 else np.full(len(by_scene), 1 / len(by_scene))
    return Estimate(mean, math.sqrt(whole), float(1 / (shares**2 / freedom).sum()))


def on_scenes_like_these(by_scene: Sequence[np.ndarray]) -> Estimate | None:
    """Mean over all scenes of which these are a sample; None with fewer than `FEWEST_SCENES`, or of `FEWEST_SEEDS` in any."""
    if len(by_scene) < FEWEST_SCENES or min(map(len, by_scene)) < FEWEST_SEEDS:
        return None
    means = np.array([part.mean() for part in by_scene])
    error = float(means.std(ddof=1)) / math.sqrt(len(means))
    return Estimate(float(means.mean()), error, len(means) - 1.0)


def holm(values: Sequence[float]) -> list[float]:
    """P-values of a family, so corrected that all those below an error level together err that seldom (Holm, 1979).

    Example:
        >>> [round(p, 2) for p in holm([0.01, 0.04, 0.03])]
        [0.03, 0.06, 0.06]
    """
    order = np.argsort(values, kind="stable")
    factors = np.arange(len(values), 0, -1)
    corrected = np.empty(len(values))
    corrected[order] = np.maximum.accumulate(
        np.minimum(1.0, factors * np.asarray(values)[order], dtype=float)
    )
    return corrected.tolist()


def probability_above(
    ours: Sequence[np.ndarray], others: Sequence[np.ndarray], higher_is_better: bool = True
) -> float:
    """How often a run of one row is better than a run of another on the same scene; ties count half.

    Mean over scenes of the share of pairs of seeds (Agarwal et al., NeurIPS 2021).
    """
    sign = 1 if higher_is_better else -1
    gaps = [np.sign(sign * np.subtract.outer(a, b)) for a, b in zip(ours, others, strict=True)]
    return float(np.mean([0.5 + gap.mean() / 2 for gap in gaps])) if gaps else math.nan


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
