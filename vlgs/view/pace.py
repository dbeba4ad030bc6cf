"""How large a picture may be to be ready in time, learnt from how long others took."""

from collections import deque
from itertools import combinations
from statistics import median

_KEPT = 12
"""Times that count."""
_APART = 1.2
"""Times more pixels from which on two sizes count as different."""
SMALLEST = 1 / 16
"""Of width and height."""


class Pace:
    """Times of one kind of picture, of which a fixed part does not depend on its size.

    Args:
        budget: Seconds that a picture may take.
        first: What `scale` says before anything is known.
    """

    def __init__(self, budget: float, first: float = 0.5) -> None:
        self.budget = budget
        self.first = first
        self._times: deque[tuple[int, float]] = deque(maxlen=_KEPT)

    def took(self, pixels: int, seconds: float) -> None:
        """Learn how long a picture took."""
        self._times.append((pixels, seconds))

    def scale(self, pixels: int) -> float:
        """What to multiply width and height with, at most 1, for a picture that would have so many pixels.

        Where the fixed part alone is above the budget, fewer pixels do not help: they may then take as long as it does.
        """
        if not self._times:
            return self.first
        fixed, each = self._fit()
        left = max(self.budget - fixed, fixed)
        return min(max((left / (each * pixels)) ** 0.5, SMALLEST), 1.0) if each > 0 else 1.0

    def _fit(self) -> tuple[float, float]:
        """Fixed seconds, and seconds for each pixel, none of them negative; medians, as single pictures may be held up."""
        pairs = combinations(self._times, 2)
        slopes = [(s - t) / (p - q) for (p, s), (q, t) in pairs if max(p, q) > _APART * min(p, q)]
        each = max(median(slopes), 0.0) if slopes else 0.0
        fixed = median(s - each * p for p, s in self._times)
        if not slopes or fixed < 0:  # sizes alike say nothing of a fixed part
            return 0.0, median(s / p for p, s in self._times)
        return fixed, each
