"""The first import of all that a run needs, without looking for garbage meanwhile. Imports no torch."""

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Around that import, which keeps all it makes: the collector would take a tenth of its time, and as much in later looks if that were not set aside.

    Does nothing for whoever has `vlgs.experiment` already, as their garbage is their own.
    """
    first = gc.isenabled() and "vlgs.experiment" not in sys.modules
    if first:
        gc.disable()
    try:
        yield
    finally:
        if first:
            gc.freeze()
            gc.enable()
