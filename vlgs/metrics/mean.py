"""The mean of a set that may be empty; all scores use it."""

from collections.abc import Iterable


def mean_of_known(values: Iterable[float | None]) -> float | None:
    """Mean over the values that are available; None if there is none, because an empty set scores neither 0 nor 1.

    Example:
        >>> mean_of_known([0.5, None, 1.0]), mean_of_known([None])
        (0.75, None)
    """
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
