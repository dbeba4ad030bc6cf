"""Kinds of one test of which some are quick to run always, others with ``-m slow`` alone."""

from collections.abc import Iterable
from typing import Any

import pytest


def with_slow(kinds: Iterable[Any], slow: Iterable[Any]) -> list[Any]:
    """Parameters of a test, those of ``slow`` marked so.

    Raises:
        ValueError: If one that should be slow is none of the kinds.
    """
    kinds, slow = list(kinds), list(slow)
    if unknown := [kind for kind in slow if kind not in kinds]:
        raise ValueError(f"slow, but no kind of the test: {unknown}")
    return [pytest.param(k, marks=pytest.mark.slow) if k in slow else k for k in kinds]
