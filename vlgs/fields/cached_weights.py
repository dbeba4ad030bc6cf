"""Cached views by name: `vlgs.ops.cached_weights` says what they are."""

import logging
from collections.abc import Hashable
from typing import Any

from vlgs.ops.cached_weights import CacheBudgetError, CachedView

log = logging.getLogger(__name__)


class CachedViews:
    """Cached views by name, as many as a budget holds.

    The first that fit stay: every view comes once per epoch, so that putting out the oldest would rebuild one each time.
    """

    def __init__(self, budget: int) -> None:
        self.budget = budget
        self.used = 0
        self._views: dict[Hashable, CachedView] = {}
        self._refused: set[Hashable] = set()

    def __len__(self) -> int:
        return len(self._views)

    def get(self, name: Hashable) -> CachedView | None:
        """The view of that name, if it is kept."""
        return self._views.get(name)

    def refused(self, name: Hashable) -> bool:
        """Whether a view of that name did not fit."""
        return name in self._refused

    def make(self, name: Hashable, **view: Any) -> CachedView | None:
        """Make and keep a view; None, with a line in the log the first time, where the budget does not hold it.

        Args:
            name: Under which `get` finds it.
            view: Arguments of `CachedView`.
        """
        try:
            made = CachedView(**view, budget=self.budget - self.used)
        except CacheBudgetError as error:
            if not self._refused:
                log.info(
                    "frozen weights: %d views in %d bytes, others are rendered in full (%s)",
                    len(self), self.used, error,
                )  # fmt: skip
            self._refused.add(name)
            return None
        self._views[name] = made
        self.used += made.nbytes
        return made
